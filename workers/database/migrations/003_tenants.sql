-- Whose a dataset or a job is, and the keys that say so. What was there before belongs to `local`, the tenant
-- of whoever runs the machine. Of the limits, none means what the settings say.
CREATE TABLE tenants (
    id text PRIMARY KEY CHECK (id ~ '^[a-z0-9][a-z0-9_-]{0,62}$'),
    weight double precision NOT NULL DEFAULT 1 CHECK (weight BETWEEN 0.1 AND 10),
    top_priority smallint NOT NULL DEFAULT 0 CHECK (top_priority BETWEEN -1 AND 1),
    max_running int CHECK (max_running >= 1),
    max_queued int CHECK (max_queued >= 0),
    max_stored_bytes bigint CHECK (max_stored_bytes >= 0),
    created_at timestamptz NOT NULL DEFAULT clock_timestamp()
);
INSERT INTO tenants (id, top_priority) VALUES ('local', 1);

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

ALTER TABLE datasets ADD COLUMN tenant text NOT NULL DEFAULT 'local' REFERENCES tenants;
ALTER TABLE datasets ADD UNIQUE (id, tenant);
ALTER TABLE jobs ADD COLUMN tenant text NOT NULL DEFAULT 'local' REFERENCES tenants;
-- Whatever a statement forgets: no job uses another tenant's dataset.
ALTER TABLE jobs DROP CONSTRAINT jobs_dataset_id_fkey;
ALTER TABLE jobs ADD FOREIGN KEY (dataset_id, tenant) REFERENCES datasets (id, tenant);
ALTER TABLE jobs DROP CONSTRAINT jobs_idempotency_key_key;
ALTER TABLE jobs ADD UNIQUE (tenant, idempotency_key);
CREATE INDEX datasets_of_tenant ON datasets (tenant, created_at DESC, id DESC);
CREATE INDEX jobs_of_tenant ON jobs (tenant, created_at DESC, id DESC);
