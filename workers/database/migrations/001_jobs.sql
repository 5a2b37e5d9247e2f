-- Datasets, jobs and their history. The queue's own tables (procrastinate_*) lie beside them.

CREATE TABLE datasets (
    id text PRIMARY KEY,
    name text NOT NULL,
    state text NOT NULL DEFAULT 'open' CHECK (state IN ('open', 'finalizing', 'ready', 'rejected')),
    manifest jsonb NOT NULL DEFAULT '[]',
    report jsonb,
    error jsonb,
    revision bigint NOT NULL DEFAULT 0,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp()
);
CREATE INDEX datasets_newest ON datasets (created_at DESC, id DESC);

CREATE TABLE dataset_files (
    dataset_id text NOT NULL REFERENCES datasets ON DELETE CASCADE,
    path text NOT NULL COLLATE "C",
    key text NOT NULL,
    size bigint NOT NULL,
    sha256 text NOT NULL,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    PRIMARY KEY (dataset_id, path)
);

-- fillfactor leaves room in each page, so that progress updates stay HOT (no index writes).
CREATE TABLE jobs (
    id text PRIMARY KEY,
    dataset_id text NOT NULL REFERENCES datasets,
    state text NOT NULL DEFAULT 'queued'
        CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    options jsonb NOT NULL,
    labels jsonb NOT NULL DEFAULT '{}',
    idempotency_key text UNIQUE,
    fingerprint text NOT NULL,
    queue_id bigint,
    attempt int NOT NULL DEFAULT 0,
    run_token uuid,
    cancel_requested boolean NOT NULL DEFAULT false,
    stage text,
    fraction double precision NOT NULL DEFAULT 0,
    step bigint NOT NULL DEFAULT 0,
    steps_total bigint NOT NULL DEFAULT 0,
    eta_s double precision,
    metrics jsonb NOT NULL DEFAULT '{}',
    message text NOT NULL DEFAULT '',
    error jsonb,
    checkpoint jsonb,
    artifacts jsonb NOT NULL DEFAULT '[]',
    seq bigint NOT NULL DEFAULT 0,
    revision bigint NOT NULL DEFAULT 0,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    started_at timestamptz,
    finished_at timestamptz,
    updated_at timestamptz NOT NULL DEFAULT clock_timestamp()
) WITH (fillfactor = 70);
CREATE INDEX jobs_newest ON jobs (created_at DESC, id DESC);
CREATE INDEX jobs_unfinished ON jobs (queue_id) WHERE state IN ('queued', 'running');
CREATE INDEX jobs_dataset ON jobs (dataset_id);

CREATE TABLE job_events (
    job_id text NOT NULL REFERENCES jobs ON DELETE CASCADE,
    seq bigint NOT NULL,
    at timestamptz NOT NULL DEFAULT clock_timestamp(),
    attempt int NOT NULL,
    type text NOT NULL,
    data jsonb NOT NULL DEFAULT '{}',
    PRIMARY KEY (job_id, seq)
);

-- File prefixes to delete, written in the transaction that makes them garbage.
CREATE TABLE trash (
    id bigint PRIMARY KEY GENERATED ALWAYS AS IDENTITY,
    prefix text NOT NULL,
    keep text,
    not_before timestamptz NOT NULL DEFAULT clock_timestamp()
);

-- Appends to a job's history. The row lock of the job makes seq gapless and in commit order.
CREATE FUNCTION add_job_event(_job_id text, _type text, _data jsonb) RETURNS bigint LANGUAGE plpgsql AS $$
DECLARE
    _seq bigint;
    _attempt int;
BEGIN
    UPDATE jobs SET seq = seq + 1, revision = revision + 1, updated_at = clock_timestamp()
        WHERE id = _job_id RETURNING seq, attempt INTO STRICT _seq, _attempt;
    INSERT INTO job_events (job_id, seq, attempt, type, data) VALUES (_job_id, _seq, _attempt, _type, _data);
    PERFORM pg_notify('biresnerf_jobs', _job_id);
    RETURN _seq;
END;
$$;
