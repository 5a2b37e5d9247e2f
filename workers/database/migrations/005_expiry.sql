-- What is over or unused for long expires: its files go, its record stays for a while and says so.
-- `expires_at` is kept up by the dispatcher, which alone deletes by it; none is never.

ALTER TABLE jobs DROP CONSTRAINT jobs_state_check;
ALTER TABLE jobs
    ADD CONSTRAINT jobs_state_check
        CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled', 'expired')),
    ADD COLUMN expires_at timestamptz;
CREATE INDEX jobs_expiry ON jobs (expires_at) WHERE expires_at IS NOT NULL;
CREATE INDEX jobs_over ON jobs (finished_at) WHERE finished_at IS NOT NULL;

ALTER TABLE datasets DROP CONSTRAINT datasets_state_check;
ALTER TABLE datasets
    ADD CONSTRAINT datasets_state_check CHECK (state IN ('open', 'finalizing', 'ready', 'rejected', 'expired')),
    ADD COLUMN touched_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    ADD COLUMN expires_at timestamptz;

CREATE FUNCTION touch() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    NEW.touched_at = clock_timestamp();
    RETURN NEW;
END;
$$;
CREATE TRIGGER touch BEFORE UPDATE ON datasets FOR EACH ROW
    WHEN (NEW.revision <> OLD.revision) EXECUTE FUNCTION touch();
