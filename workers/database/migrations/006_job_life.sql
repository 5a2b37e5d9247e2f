-- The life of a job: its log, previews, a partial result on request, a smaller second try, work that another
-- job can start from, and exports of its result (jobs of their own, below it).
ALTER TABLE jobs
    ADD COLUMN kind text NOT NULL DEFAULT 'refine' CHECK (kind IN ('refine', 'export')),
    ADD COLUMN parent text REFERENCES jobs ON DELETE CASCADE,
    ADD COLUMN asked jsonb,
    ADD COLUMN smaller jsonb NOT NULL DEFAULT '{}',
    ADD COLUMN keep_partial boolean NOT NULL DEFAULT false,
    ADD COLUMN partial boolean NOT NULL DEFAULT false,
    ADD COLUMN previews jsonb,
    ADD COLUMN reusable jsonb NOT NULL DEFAULT '{}',
    ADD COLUMN forked_from text,
    ADD COLUMN forked_stage text,
    ADD COLUMN log_lines bigint NOT NULL DEFAULT 0;
CREATE INDEX jobs_parent ON jobs (parent) WHERE parent IS NOT NULL;
-- Of two exports of one result in the same forms, the second is the first.
CREATE UNIQUE INDEX jobs_one_export ON jobs (parent, fingerprint)
    WHERE kind = 'export' AND state IN ('queued', 'running', 'succeeded');

CREATE TABLE job_log (
    job_id text NOT NULL REFERENCES jobs ON DELETE CASCADE,
    n bigint NOT NULL,
    at timestamptz NOT NULL DEFAULT clock_timestamp(),
    attempt int NOT NULL,
    text text NOT NULL,
    PRIMARY KEY (job_id, n)
);

-- Whoever deletes a job, and the exports below it with it: their files go too.
CREATE FUNCTION job_files_to_trash() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO trash (prefix) VALUES ('jobs/' || OLD.id);
    RETURN OLD;
END;
$$;
CREATE TRIGGER job_files_to_trash AFTER DELETE ON jobs FOR EACH ROW EXECUTE FUNCTION job_files_to_trash();
