-- Which file store belongs to this database, so that a process with another folder or bucket refuses to start.
CREATE TABLE file_store (
    only_one boolean PRIMARY KEY DEFAULT true CHECK (only_one),
    id text NOT NULL
);

-- Keys that every replica must agree on, made at first use where the operator gave none.
CREATE TABLE server_secrets (
    name text PRIMARY KEY,
    value bytea NOT NULL
);

-- Uploads under way. Their bytes lie below `folder` in the file store, which goes to the trash with the row.
CREATE TABLE uploads (
    id text PRIMARY KEY,
    dataset_id text NOT NULL REFERENCES datasets ON DELETE CASCADE,
    kind text NOT NULL CHECK (kind IN ('archive', 'file', 'signed')),
    path text COLLATE "C",
    size bigint NOT NULL CHECK (size >= 0),
    sha256 text,
    state text NOT NULL DEFAULT 'receiving' CHECK (state IN ('receiving', 'received', 'stored', 'rejected')),
    received bigint NOT NULL DEFAULT 0 CHECK (received BETWEEN 0 AND size),
    folder text NOT NULL,
    error jsonb,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    expires_at timestamptz NOT NULL,
    CHECK ((kind = 'archive') = (path IS NULL))
);
CREATE INDEX uploads_dataset ON uploads (dataset_id);
CREATE INDEX uploads_expiry ON uploads (expires_at);

-- What has arrived of an upload, in stored pieces without gaps: `received` is the end of the last one.
CREATE TABLE upload_pieces (
    upload_id text NOT NULL REFERENCES uploads ON DELETE CASCADE,
    start bigint NOT NULL,
    size bigint NOT NULL CHECK (size > 0),
    key text NOT NULL,
    PRIMARY KEY (upload_id, start)
);

-- "Does this tenant have these bytes already?"
CREATE INDEX dataset_files_content ON dataset_files (sha256, size);
