"""What a job is, how it is queued, who runs it, what happens when it dies, where files lie.

Nothing here loads torch except `workers.run.job_process`, the program of one job's child process.
"""
