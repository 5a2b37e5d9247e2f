-- Who checks a dataset, and until when that holds without a sign of life.
ALTER TABLE datasets ADD COLUMN check_token uuid, ADD COLUMN check_until timestamptz;
-- Few are unfinished at any time; each process looks for them now and then.
CREATE INDEX datasets_unfinished ON datasets (created_at) WHERE state = 'finalizing';
