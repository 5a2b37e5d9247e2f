"""The record of a job: submitted, listed, followed, ended. Running it is `run`'s."""
