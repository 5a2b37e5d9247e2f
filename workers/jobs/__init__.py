"""The record of a job, and all SQL on it: submitted, listed, followed, claimed, reported on, ended, expired."""
