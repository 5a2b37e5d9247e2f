-- The schema of release 0.1: tables, views and indexes. Their functions and triggers follow in 2_functions.sql; the
-- queue's own tables, views and functions come first, from workers/database/job_queue.py.

-- Tenants, and the keys that identify them. `local` is the tenant of whoever runs the machine. A limit of 0 is no
-- limit; where a limit is null, tenant_defaults holds.
CREATE TABLE tenants (
    id text PRIMARY KEY CHECK (id ~ '^[a-z0-9][a-z0-9_-]{0,62}$'),
    weight double precision NOT NULL DEFAULT 1 CHECK (weight BETWEEN 0.1 AND 10),
    top_priority smallint NOT NULL DEFAULT 0 CHECK (top_priority BETWEEN -1 AND 1),
    max_running int CHECK (max_running >= 0),
    max_queued int CHECK (max_queued >= 0),
    max_stored_bytes bigint CHECK (max_stored_bytes >= 0),
    max_daily_seconds bigint CHECK (max_daily_seconds >= 0),
    created_at timestamptz NOT NULL DEFAULT clock_timestamp()
);
INSERT INTO tenants (id, top_priority, max_running, max_queued, max_stored_bytes, max_daily_seconds)
    VALUES ('local', 1, 0, 0, 0, 0);

-- Written by the web process from its settings.
CREATE TABLE tenant_defaults (
    one boolean PRIMARY KEY DEFAULT true CHECK (one),
    max_running int NOT NULL DEFAULT 0,
    max_queued int NOT NULL DEFAULT 0,
    max_stored_bytes bigint NOT NULL DEFAULT 0,
    max_daily_seconds bigint NOT NULL DEFAULT 0
);
INSERT INTO tenant_defaults DEFAULT VALUES;

CREATE VIEW tenant_limits AS
    SELECT tenants.id, tenants.weight, tenants.top_priority,
        coalesce(tenants.max_running, usual.max_running) AS max_running,
        coalesce(tenants.max_queued, usual.max_queued) AS max_queued,
        coalesce(tenants.max_stored_bytes, usual.max_stored_bytes) AS max_stored_bytes,
        coalesce(tenants.max_daily_seconds, usual.max_daily_seconds) AS max_daily_seconds
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

-- `check_token`, `check_until`: who checks the dataset, and until when without a sign of life. `check_losses`: how many
-- processes in a row were lost while they read it and got no further; `check_photos`: by how many photos one got furthest,
-- of `check_of`.
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
    check_losses int NOT NULL DEFAULT 0,
    check_photos int NOT NULL DEFAULT 0,
    check_of int,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    touched_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    expires_at timestamptz,
    UNIQUE (id, tenant)
);
CREATE INDEX datasets_newest ON datasets (created_at DESC, id DESC);
CREATE INDEX datasets_of_tenant ON datasets (tenant, created_at DESC, id DESC);
CREATE INDEX datasets_unfinished ON datasets (created_at) WHERE state = 'finalizing';
CREATE INDEX datasets_of_state ON datasets (state);
CREATE INDEX datasets_touched ON datasets (touched_at);
CREATE INDEX datasets_expiry ON datasets (expires_at) WHERE expires_at IS NOT NULL;

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

-- Who brings an archive into a dataset, and until when without a sign of life: closing the dataset waits.
CREATE TABLE dataset_imports (
    token uuid PRIMARY KEY,
    dataset_id text NOT NULL REFERENCES datasets ON DELETE CASCADE,
    live_until timestamptz NOT NULL
);
CREATE INDEX dataset_imports_dataset ON dataset_imports (dataset_id);

-- Uploads under way. Their bytes lie below `folder` in the file store, which goes to the trash with the row.
-- `take_token`, `take_until`: who brings a received upload into its dataset, and until when without a sign of life.
-- `losses`: how many in a row were lost while they unpacked it.
-- `brought`: bytes that the dataset has already, and that are counted there. `host`: where a dispatcher fetches them;
-- until it knows their number, `size` is a byte more than there are.
CREATE TABLE uploads (
    id text PRIMARY KEY,
    dataset_id text NOT NULL REFERENCES datasets ON DELETE CASCADE,
    kind text NOT NULL CHECK (kind IN ('archive', 'file', 'signed')),
    path text COLLATE "C",
    size bigint NOT NULL CHECK (size >= 0),
    sha256 text,
    host text,
    state text NOT NULL DEFAULT 'receiving' CHECK (state IN ('receiving', 'received', 'stored', 'rejected')),
    received bigint NOT NULL DEFAULT 0 CHECK (received BETWEEN 0 AND size),
    brought bigint NOT NULL DEFAULT 0 CHECK (brought BETWEEN 0 AND size),
    folder text NOT NULL,
    error jsonb,
    take_token uuid,
    take_until timestamptz,
    losses int NOT NULL DEFAULT 0,
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

-- Uploads that a dispatcher is to fetch. `url` is a secret: the row goes once all bytes are here, or none will be.
-- `size`: as announced. `etag`: what the pieces so far are of. `round`: tries in a row that brought little.
-- `token`, `leased_until`: who fetches it; `losses`: how many in a row were lost who did and brought nothing.
CREATE TABLE upload_fetches (
    id text PRIMARY KEY REFERENCES uploads ON DELETE CASCADE,
    url text NOT NULL,
    size bigint,
    etag text,
    round int NOT NULL DEFAULT 0,
    due_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    token uuid,
    leased_until timestamptz,
    losses int NOT NULL DEFAULT 0
);

CREATE FUNCTION bytes_of_artifacts(_artifacts jsonb) RETURNS bigint LANGUAGE sql IMMUTABLE AS $$
    SELECT coalesce(sum((item ->> 'size')::bigint), 0)::bigint FROM jsonb_array_elements(_artifacts) AS item
$$;

-- Jobs that were submitted together; see close_batch() and drop_batch().
CREATE TABLE batches (
    id text PRIMARY KEY,
    tenant text NOT NULL REFERENCES tenants,
    idempotency_key text,
    fingerprint text NOT NULL,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    finished_at timestamptz,
    UNIQUE (tenant, idempotency_key)
);
CREATE INDEX batches_with_key ON batches (finished_at) WHERE idempotency_key IS NOT NULL;

-- `queue_order`: priority first, then turn; lower runs earlier. `held`: the tenant has as many jobs offered or
-- running as it may; the queue does not offer this one until one of those ends. `trace`: the W3C traceparent of the
-- submission, which attempts join. An export of a result is a job below its `parent`. `options`: as requested;
-- `resolved_options`: as the latest attempt used them; `planned_steps`: the cost of the job, which decides its turn.
-- `crashes`: attempts that crashed since the last checkpoint; `losses`: that lost their worker, which is seldom the
-- job's fault and counts apart; `setback`: why the last attempt ended before its job did. `slot_kind`: of the slot that
-- runs the job, or ran it last. `part_photos`: a job on more photos splits itself into jobs below it, each on about so
-- many; none: as the operator says. `awaits_parts`: it is held until these are over, and then joins their results.
-- `fixed_from`: the job whose result this one joins its photos to. (No reference: what
-- was joined stays when the other is deleted.) `share_round`: signed into links to its files; the next one ends them.
-- `key_id`: the API key that submitted it. `attempt_…`: of the latest attempt, when it began, when it was last known to
-- run, and its processor seconds until then; `processor_s`, `wall_s`, `gpu_s`: what all attempts that are over used.
-- `start_by`: a job that has not started by then ends as expired; never after `deadline_at`, at which all else of it ends.
-- fillfactor leaves space in each page, so that progress updates stay HOT (no index writes).
CREATE TABLE jobs (
    id text PRIMARY KEY,
    tenant text NOT NULL DEFAULT 'local' REFERENCES tenants,
    dataset_id text NOT NULL,
    kind text NOT NULL DEFAULT 'refine' CHECK (kind IN ('refine', 'export')),
    parent text REFERENCES jobs ON DELETE CASCADE,
    forked_from text,
    forked_stage text,
    fixed_from text,
    part_photos int,
    awaits_parts boolean NOT NULL DEFAULT false,
    batch_id text REFERENCES batches,
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
    crashes int NOT NULL DEFAULT 0,
    losses int NOT NULL DEFAULT 0,
    share_round int NOT NULL DEFAULT 0,
    setback text CHECK (setback IN ('worker_lost', 'killed', 'error', 'disk_full', 'store_away')),
    slot_kind text,
    run_token uuid,
    key_id text,
    attempt_started_at timestamptz,
    attempt_seen_at timestamptz,
    attempt_processor_s double precision NOT NULL DEFAULT 0,
    processor_s double precision NOT NULL DEFAULT 0,
    wall_s double precision NOT NULL DEFAULT 0,
    gpu_s double precision NOT NULL DEFAULT 0,
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
    delivered jsonb NOT NULL DEFAULT '[]',
    stored_bytes bigint GENERATED ALWAYS AS (bytes_of_artifacts(artifacts)) STORED,
    log_lines bigint NOT NULL DEFAULT 0,
    trace text,
    seq bigint NOT NULL DEFAULT 0,
    revision bigint NOT NULL DEFAULT 0,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    start_by timestamptz CHECK (start_by <= deadline_at),
    deadline_at timestamptz,
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
CREATE INDEX jobs_of_batch ON jobs (batch_id) WHERE batch_id IS NOT NULL;
CREATE INDEX jobs_due ON jobs (start_by) WHERE start_by IS NOT NULL AND state IN ('queued', 'running');
CREATE INDEX jobs_expiry ON jobs (expires_at) WHERE expires_at IS NOT NULL;
CREATE INDEX jobs_over ON jobs (finished_at) WHERE finished_at IS NOT NULL;
CREATE INDEX jobs_fixed ON jobs (fixed_from) WHERE fixed_from IS NOT NULL;
-- Each upload and submission sums what a tenant stores, and metrics count jobs by state: with 100,000 jobs 213 and
-- 187 ms without these two indexes, 9 ms each with them.
CREATE INDEX jobs_stored ON jobs (tenant) INCLUDE (stored_bytes);
CREATE INDEX jobs_of_state ON jobs (state);
-- So that rounds of upkeep read what changed and lists read what they show, not all jobs that ever were (docs/scaling.md).
CREATE INDEX jobs_undated ON jobs (finished_at)
    WHERE finished_at IS NOT NULL AND expires_at IS NULL AND state <> 'expired';
CREATE INDEX jobs_with_key ON jobs (finished_at) WHERE idempotency_key IS NOT NULL;
CREATE INDEX jobs_forked ON jobs (forked_from) WHERE forked_from IS NOT NULL;
CREATE INDEX jobs_of_tenant_in_state ON jobs (tenant, state, created_at DESC, id DESC);
CREATE INDEX jobs_labels ON jobs USING gin (labels jsonb_path_ops);
-- Of two exports of one result in the same formats, the second is the first.
CREATE UNIQUE INDEX jobs_one_export ON jobs (parent, fingerprint)
    WHERE kind = 'export' AND state IN ('queued', 'running', 'succeeded');

-- Files of a job that a dispatcher is to send once it is over; `jobs.delivered` says what became of them. `name`: none
-- for a zip of all. `url` is a secret: the row goes once the file was sent or will not be. The others: `upload_fetches`.
CREATE TABLE job_deliveries (
    id text PRIMARY KEY,
    job_id text NOT NULL REFERENCES jobs ON DELETE CASCADE,
    name text,
    url text NOT NULL,
    round int NOT NULL DEFAULT 0,
    due_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    token uuid,
    leased_until timestamptz,
    losses int NOT NULL DEFAULT 0
);
CREATE INDEX job_deliveries_job ON job_deliveries (job_id);

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

CREATE VIEW running_jobs AS
    SELECT id, tenant, kind, queue_id, attempt, stage, fraction, attempt_started_at AS since FROM jobs
    WHERE state = 'running';
CREATE VIEW failed_jobs AS
    SELECT id, tenant, finished_at, error ->> 'code' AS code, error ->> 'detail' AS detail FROM jobs
    WHERE state = 'failed';
CREATE VIEW unfinished_jobs AS
    SELECT priority, count(*) FILTER (WHERE state = 'queued' AND NOT held) AS waiting,
        count(*) FILTER (WHERE state = 'queued' AND held) AS held, count(*) FILTER (WHERE state = 'running') AS running,
        min(created_at) FILTER (WHERE state = 'queued') AS oldest_at
    FROM jobs WHERE state IN ('queued', 'running') GROUP BY priority;
-- How much work waits, for autoscalers and monitoring. Names and columns of this view are kept: what runs outside of
-- this program reads it (docs/operations.md). A role needs no other right than SELECT on it.
-- A slot of any kind takes any job, so that `waiting`, `held` and `oldest_s` are the same for each kind. `held` jobs
-- wait for their tenant's limit: no further slot would be given one. An export needs no slot of its own while a
-- refinement waits or runs: the slot of a refinement exports beside it. Counted as a waiting job, it made autoscalers
-- start a worker that found nothing to do; counted as a running one, it hid a worker that was free.
CREATE VIEW queue_depth AS
    SELECT kinds.slot_kind,
        count(*) FILTER (WHERE job.state = 'queued' AND NOT job.held AND job.needs_slot) AS waiting,
        count(*) FILTER (WHERE job.state = 'queued' AND job.held) AS held,
        count(*) FILTER (WHERE job.state = 'running' AND job.needs_slot
            AND coalesce(job.slot_kind, 'cpu') = kinds.slot_kind) AS running,
        greatest(coalesce(extract(epoch FROM clock_timestamp()
            - min(job.created_at) FILTER (WHERE job.state = 'queued' AND NOT job.held)), 0), 0)::float8 AS oldest_s
    FROM (VALUES ('cpu'), ('gpu')) AS kinds (slot_kind)
    LEFT JOIN (
        SELECT state, held, slot_kind, created_at, kind = 'refine' OR NOT EXISTS (
            SELECT FROM jobs WHERE kind = 'refine' AND NOT held AND state IN ('queued', 'running')) AS needs_slot
        FROM jobs WHERE state IN ('queued', 'running')
    ) AS job ON true
    GROUP BY kinds.slot_kind ORDER BY kinds.slot_kind;

-- What attempts used, by the day (UTC) on which they ended; it stays when jobs are deleted. Each attempt is a row of its
-- own first, so that no two jobs wait for one another; a janitor adds the rows up. `key_id` is empty without a key.
CREATE TABLE use_records (
    day date NOT NULL DEFAULT (clock_timestamp() AT TIME ZONE 'UTC')::date,
    tenant text NOT NULL,
    key_id text NOT NULL,
    device text NOT NULL CHECK (device IN ('cpu', 'gpu')),
    attempts bigint NOT NULL DEFAULT 1,
    processor_s double precision NOT NULL,
    wall_s double precision NOT NULL
);
CREATE INDEX use_records_of_tenant ON use_records (tenant, day);

-- Links that show the page of one job to people without a key. Like a key, only the SHA-256 of the text is stored.
CREATE TABLE result_links (
    id text PRIMARY KEY,
    job_id text NOT NULL REFERENCES jobs ON DELETE CASCADE,
    prefix text NOT NULL UNIQUE,
    sha256 bytea NOT NULL,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    expires_at timestamptz NOT NULL
);
CREATE INDEX result_links_of_job ON result_links (job_id, created_at);

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
CREATE TABLE slots (
    host text,
    name text,
    worker_id bigint NOT NULL,
    kind text GENERATED ALWAYS AS (CASE WHEN name LIKE 'gpu%' THEN 'gpu' ELSE 'cpu' END) STORED,
    PRIMARY KEY (host, name)
);

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
    batch_id text REFERENCES batches ON DELETE CASCADE,  -- likewise
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
CREATE INDEX webhooks_batch ON webhooks (batch_id) WHERE batch_id IS NOT NULL;

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
CREATE INDEX webhook_deliveries_over ON webhook_deliveries (finished_at) WHERE finished_at IS NOT NULL;
CREATE INDEX webhook_deliveries_pending ON webhook_deliveries (due_at) WHERE state = 'pending';
CREATE INDEX webhook_deliveries_waiting ON webhook_deliveries (webhook_id) WHERE state = 'pending';
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

-- Rate limits, shared by all web processes: when the client's bucket is full again, if it sends nothing more. Such a
-- time says all about a bucket; a row of the past is a full one. Unlogged: after a crash all buckets are full.
CREATE UNLOGGED TABLE token_buckets (
    policy text NOT NULL,
    client text NOT NULL,
    full_at timestamptz NOT NULL,
    PRIMARY KEY (policy, client)
) WITH (fillfactor = 50);

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
