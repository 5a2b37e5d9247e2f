"""The job engine: datasets, jobs, queue, workers, recovery, and file storage.

Nothing here loads torch except `workers.run.job_process`, the program of one job's child process.
"""
