-- The first schema: tables and indexes. Their functions and triggers follow in 002_functions.sql; the queue's own
-- tables, views and functions come first, from workers/database/job_queue.py.

-- Tenants, and the keys that identify them. `local` is the tenant of whoever runs the machine. A limit of 0 is no
-- limit; where a limit is null, tenant_defaults holds.
CREATE TABLE tenants (
    id text PRIMARY KEY CHECK (id ~ '^[a-z0-9][a-z0-9_-]{0,62}$'),
    weight double precision NOT NULL DEFAULT 1 CHECK (weight BETWEEN 0.1 AND 10),
    top_priority smallint NOT NULL DEFAULT 0 CHECK (top_priority BETWEEN -1 AND 1),
    max_running int CHECK (max_running >= 0),
    max_queued int CHECK (max_queued >= 0),
    max_stored_bytes bigint CHECK (max_stored_bytes >= 0),
    created_at timestamptz NOT NULL DEFAULT clock_timestamp()
);
INSERT INTO tenants (id, top_priority, max_running, max_queued, max_stored_bytes) VALUES ('local', 1, 0, 0, 0);

-- Written by the web process from its settings.
CREATE TABLE tenant_defaults (
    one boolean PRIMARY KEY DEFAULT true CHECK (one),
    max_running int NOT NULL DEFAULT 0,
    max_queued int NOT NULL DEFAULT 0,
    max_stored_bytes bigint NOT NULL DEFAULT 0
);
INSERT INTO tenant_defaults DEFAULT VALUES;

CREATE VIEW tenant_limits AS
    SELECT tenants.id, tenants.weight, tenants.top_priority,
        coalesce(tenants.max_running, usual.max_running) AS max_running,
        coalesce(tenants.max_queued, usual.max_queued) AS max_queued,
        coalesce(tenants.max_stored_bytes, usual.max_stored_bytes) AS max_stored_bytes
    FROM tenants CROSS JOIN tenant_defaults AS usual;

-- Of a key only the SHA-256 is kept; `prefix` is its public part, by which it is found and shown.
CREATE TABLE api_keys (
    id text PRIMARY KEY,
    tenant text NOT NULL REFERENCES tenants,
    name text NOT NULL,
    prefix text NOT NULL UNIQUE,
    sha256 bytea NOT NULL CHECK (length(sha256) = 32),
    scopes text[] NOT NULL CHECK (scopes <@ ARRAY['read', 'datasets:write', 'jobs:write', 'admin']),
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    expires_at timestamptz,
    revoked_at timestamptz,
    last_used_at timestamptz
);

-- `check_token`, `check_until`: who checks the dataset, and until when without a sign of life.
-- `expires_at` is kept up to date by the dispatcher, which alone deletes by it; null is never.
CREATE TABLE datasets (
    id text PRIMARY KEY,
    tenant text NOT NULL DEFAULT 'local' REFERENCES tenants,
    name text NOT NULL,
    state text NOT NULL DEFAULT 'open' CHECK (state IN ('open', 'finalizing', 'ready', 'rejected', 'expired')),
    manifest jsonb NOT NULL DEFAULT '[]',
    report jsonb,
    error jsonb,
    revision bigint NOT NULL DEFAULT 0,
    stored_bytes bigint NOT NULL DEFAULT 0,
    check_token uuid,
    check_until timestamptz,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    touched_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    expires_at timestamptz,
    UNIQUE (id, tenant)
);
CREATE INDEX datasets_newest ON datasets (created_at DESC, id DESC);
CREATE INDEX datasets_of_tenant ON datasets (tenant, created_at DESC, id DESC);
CREATE INDEX datasets_unfinished ON datasets (created_at) WHERE state = 'finalizing';

CREATE TABLE dataset_files (
    dataset_id text NOT NULL REFERENCES datasets ON DELETE CASCADE,
    path text NOT NULL COLLATE "C",
    key text NOT NULL,
    size bigint NOT NULL,
    sha256 text NOT NULL,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    PRIMARY KEY (dataset_id, path)
);
CREATE INDEX dataset_files_content ON dataset_files (sha256, size);

-- Uploads under way. Their bytes lie below `folder` in the file store, which goes to the trash with the row.
-- `take_token`, `take_until`: who brings a received upload into its dataset, and until when without a sign of life.
-- `brought`: bytes that the dataset has already, and that are counted there.
CREATE TABLE uploads (
    id text PRIMARY KEY,
    dataset_id text NOT NULL REFERENCES datasets ON DELETE CASCADE,
    kind text NOT NULL CHECK (kind IN ('archive', 'file', 'signed')),
    path text COLLATE "C",
    size bigint NOT NULL CHECK (size >= 0),
    sha256 text,
    state text NOT NULL DEFAULT 'receiving' CHECK (state IN ('receiving', 'received', 'stored', 'rejected')),
    received bigint NOT NULL DEFAULT 0 CHECK (received BETWEEN 0 AND size),
    brought bigint NOT NULL DEFAULT 0 CHECK (brought BETWEEN 0 AND size),
    folder text NOT NULL,
    error jsonb,
    take_token uuid,
    take_until timestamptz,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    expires_at timestamptz NOT NULL,
    CHECK ((kind = 'archive') = (path IS NULL))
);
CREATE INDEX uploads_dataset ON uploads (dataset_id);
CREATE INDEX uploads_expiry ON uploads (expires_at);
CREATE INDEX uploads_received ON uploads (created_at) WHERE state = 'received';

-- What has arrived of an upload, without gaps: `received` is the end of the last piece.
CREATE TABLE upload_pieces (
    upload_id text NOT NULL REFERENCES uploads ON DELETE CASCADE,
    start bigint NOT NULL,
    size bigint NOT NULL CHECK (size > 0),
    key text NOT NULL,
    PRIMARY KEY (upload_id, start)
);

CREATE FUNCTION bytes_of_artifacts(_artifacts jsonb) RETURNS bigint LANGUAGE sql IMMUTABLE AS $$
    SELECT coalesce(sum((item ->> 'size')::bigint), 0)::bigint FROM jsonb_array_elements(_artifacts) AS item
$$;

-- `queue_order`: priority first, then turn; lower runs earlier. `held`: the tenant has as many jobs offered or
-- running as it may; the queue does not offer this one until one of those ends. `trace`: the W3C traceparent of the
-- submission, which attempts join. An export of a result is a job below its `parent`. `options`: as requested;
-- `resolved_options`: as the latest attempt used them; `planned_steps`: the cost of the job, which decides its turn.
-- fillfactor leaves space in each page, so that progress updates stay HOT (no index writes).
CREATE TABLE jobs (
    id text PRIMARY KEY,
    tenant text NOT NULL DEFAULT 'local' REFERENCES tenants,
    dataset_id text NOT NULL,
    kind text NOT NULL DEFAULT 'refine' CHECK (kind IN ('refine', 'export')),
    parent text REFERENCES jobs ON DELETE CASCADE,
    forked_from text,
    forked_stage text,
    state text NOT NULL DEFAULT 'queued'
        CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled', 'expired')),
    options jsonb NOT NULL,
    planned_steps int,
    resolved_options jsonb,
    smaller jsonb NOT NULL DEFAULT '{}',
    labels jsonb NOT NULL DEFAULT '{}',
    idempotency_key text,
    fingerprint text NOT NULL,
    priority smallint NOT NULL DEFAULT 0 CHECK (priority BETWEEN -1 AND 1),
    turn double precision NOT NULL DEFAULT 0,
    queue_order int NOT NULL DEFAULT 0,
    held boolean NOT NULL DEFAULT false,
    queue_id bigint,
    attempt int NOT NULL DEFAULT 0,
    run_token uuid,
    cancel_requested boolean NOT NULL DEFAULT false,
    keep_partial boolean NOT NULL DEFAULT false,
    partial boolean NOT NULL DEFAULT false,
    stage text,
    fraction double precision NOT NULL DEFAULT 0,
    step bigint NOT NULL DEFAULT 0,
    steps_total bigint NOT NULL DEFAULT 0,
    eta_s double precision,
    metrics jsonb NOT NULL DEFAULT '{}',
    message text NOT NULL DEFAULT '',
    verdict text,
    error jsonb,
    checkpoint jsonb,
    reusable jsonb NOT NULL DEFAULT '{}',
    previews jsonb,
    artifacts jsonb NOT NULL DEFAULT '[]',
    stored_bytes bigint GENERATED ALWAYS AS (bytes_of_artifacts(artifacts)) STORED,
    log_lines bigint NOT NULL DEFAULT 0,
    trace text,
    seq bigint NOT NULL DEFAULT 0,
    revision bigint NOT NULL DEFAULT 0,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    started_at timestamptz,
    finished_at timestamptz,
    updated_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    expires_at timestamptz,
    UNIQUE (tenant, idempotency_key),
    FOREIGN KEY (dataset_id, tenant) REFERENCES datasets (id, tenant)  -- no job uses another tenant's dataset
) WITH (fillfactor = 70);
CREATE INDEX jobs_newest ON jobs (created_at DESC, id DESC);
CREATE INDEX jobs_of_tenant ON jobs (tenant, created_at DESC, id DESC);
CREATE INDEX jobs_dataset ON jobs (dataset_id);
CREATE INDEX jobs_parent ON jobs (parent) WHERE parent IS NOT NULL;
CREATE INDEX jobs_unfinished ON jobs (queue_id) WHERE state IN ('queued', 'running');
CREATE INDEX jobs_waiting ON jobs (queue_order, queue_id) WHERE state = 'queued';
CREATE INDEX jobs_waiting_of_tenant ON jobs (tenant, priority, turn) WHERE state = 'queued';
CREATE INDEX jobs_held ON jobs (tenant, queue_order, queue_id) WHERE held AND state = 'queued';
CREATE INDEX jobs_offered ON jobs (tenant) WHERE NOT held AND state IN ('queued', 'running');
CREATE INDEX jobs_expiry ON jobs (expires_at) WHERE expires_at IS NOT NULL;
CREATE INDEX jobs_over ON jobs (finished_at) WHERE finished_at IS NOT NULL;
-- Of two exports of one result in the same formats, the second is the first.
CREATE UNIQUE INDEX jobs_one_export ON jobs (parent, fingerprint)
    WHERE kind = 'export' AND state IN ('queued', 'running', 'succeeded');

-- What is asked of jobs from outside of workers/jobs.
CREATE VIEW job_counts AS
    SELECT state, count(*) AS jobs, min(created_at) AS oldest_at FROM jobs GROUP BY state;
CREATE VIEW tenant_jobs AS
    SELECT tenant, count(*) FILTER (WHERE state = 'running') AS running, count(*) FILTER (WHERE state = 'queued') AS queued
    FROM jobs WHERE state IN ('queued', 'running') GROUP BY tenant;
CREATE VIEW dataset_jobs AS
    SELECT dataset_id, count(*) FILTER (WHERE state IN ('queued', 'running')) AS unfinished,
        max(finished_at) AS finished_at, greatest(max(created_at), max(finished_at)) AS used_at
    FROM jobs GROUP BY dataset_id;
CREATE VIEW job_file_keys AS
    SELECT item ->> 'key' AS key FROM jobs, jsonb_array_elements(artifacts) AS item
    UNION SELECT item ->> 'key' FROM jobs, jsonb_array_elements(previews -> 'artifacts') AS item
    UNION SELECT (part.value ->> 'prefix') || '/' || name FROM jobs, jsonb_each(reusable) AS part,
        jsonb_array_elements_text(part.value -> 'files') AS name
    UNION SELECT (checkpoint ->> 'prefix') || '/' || name
        FROM jobs, jsonb_array_elements_text(checkpoint -> 'files') AS name WHERE checkpoint IS NOT NULL;

CREATE TABLE job_events (
    job_id text NOT NULL REFERENCES jobs ON DELETE CASCADE,
    seq bigint NOT NULL,
    at timestamptz NOT NULL DEFAULT clock_timestamp(),
    attempt int NOT NULL,
    type text NOT NULL,
    data jsonb NOT NULL DEFAULT '{}',
    PRIMARY KEY (job_id, seq)
);

CREATE TABLE job_log (
    job_id text NOT NULL REFERENCES jobs ON DELETE CASCADE,
    n bigint NOT NULL,
    at timestamptz NOT NULL DEFAULT clock_timestamp(),
    attempt int NOT NULL,
    text text NOT NULL,
    PRIMARY KEY (job_id, n)
);

-- The turn of the job that started last, by priority; see give_turn().
CREATE TABLE fair_clock (
    priority smallint PRIMARY KEY,
    turn double precision NOT NULL DEFAULT 0
);
INSERT INTO fair_clock (priority) VALUES (-1), (0), (1);

-- Which of the queue's workers is which slot, for as long as it lives.
CREATE TABLE slots (host text, name text, worker_id bigint NOT NULL, PRIMARY KEY (host, name));

-- File prefixes to delete, written in the transaction that makes them garbage.
CREATE TABLE trash (
    id bigint PRIMARY KEY GENERATED ALWAYS AS IDENTITY,
    prefix text NOT NULL,
    keep text,
    not_before timestamptz NOT NULL DEFAULT clock_timestamp()
);

-- Which file store belongs to this database, so that a process with another folder or bucket refuses to start.
CREATE TABLE file_store (
    only_one boolean PRIMARY KEY DEFAULT true CHECK (only_one),
    id text NOT NULL
);

-- Keys that every replica must agree on, made at first use where the operator gave none.
CREATE TABLE server_secrets (name text PRIMARY KEY, value bytea NOT NULL);

-- Webhooks, and the messages to send, written in the transaction of the change they report.
CREATE TABLE webhooks (
    id text PRIMARY KEY,
    tenant text NOT NULL REFERENCES tenants,
    job_id text REFERENCES jobs ON DELETE CASCADE,  -- gets events of this job only, and is deleted with it
    url text NOT NULL,
    description text NOT NULL DEFAULT '',
    events text[] NOT NULL,
    secret text NOT NULL,
    previous_secret text,
    previous_until timestamptz,
    enabled boolean NOT NULL DEFAULT true,
    disabled_why text,
    failing_since timestamptz,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp()
);
CREATE INDEX webhooks_tenant ON webhooks (tenant, created_at DESC, id DESC);
CREATE INDEX webhooks_job ON webhooks (job_id) WHERE job_id IS NOT NULL;

CREATE TABLE webhook_deliveries (
    id text PRIMARY KEY,
    webhook_id text NOT NULL REFERENCES webhooks ON DELETE CASCADE,
    event text NOT NULL,
    body text NOT NULL,
    state text NOT NULL DEFAULT 'pending' CHECK (state IN ('pending', 'delivered', 'failed')),
    attempts int NOT NULL DEFAULT 0,
    round int NOT NULL DEFAULT 0,  -- attempts since it was queued (again)
    due_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    leased_until timestamptz,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    finished_at timestamptz
);
CREATE INDEX webhook_deliveries_pending ON webhook_deliveries (due_at) WHERE state = 'pending';
CREATE INDEX webhook_deliveries_newest ON webhook_deliveries (webhook_id, created_at DESC, id DESC);

-- The outcome of each attempt. Of the receiver's answer only the status is kept, not the body.
CREATE TABLE webhook_attempts (
    delivery_id text NOT NULL REFERENCES webhook_deliveries ON DELETE CASCADE,
    number int NOT NULL,
    at timestamptz NOT NULL,
    seconds double precision NOT NULL,
    status int,
    error text,
    PRIMARY KEY (delivery_id, number)
);

-- What monitoring counts, in the transaction that makes it so: exact, and no process has to be asked. Each count is a
-- row of its own first, so that no two jobs wait for one another's counter; a janitor adds the rows up.
CREATE TABLE tally_log (
    name text NOT NULL,
    label text NOT NULL DEFAULT '',
    bucket smallint NOT NULL DEFAULT 0,
    amount double precision NOT NULL DEFAULT 1
);
CREATE TABLE tallies (
    name text NOT NULL,
    label text NOT NULL,
    bucket smallint NOT NULL,
    count bigint NOT NULL,
    amount double precision NOT NULL,
    PRIMARY KEY (name, label, bucket)
);
