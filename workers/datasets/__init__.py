"""Datasets and the uploads that fill them, and their check in a child process."""
