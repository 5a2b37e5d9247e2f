-- To count who waits without reading the jobs: 10,000 take 2 ms instead of 30, at each submit and each look at one.
CREATE INDEX jobs_queued ON jobs (queue_id) WHERE state = 'queued';
