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
