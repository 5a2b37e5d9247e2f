-- Rate limits, shared by all web processes: when the client's bucket is full again, if it sends nothing more. Such a
-- time says all about a bucket; a row of the past is a full one. Unlogged: after a crash all buckets are full.
CREATE UNLOGGED TABLE token_buckets (
    policy text NOT NULL,
    client text NOT NULL,
    full_at timestamptz NOT NULL,
    PRIMARY KEY (policy, client)
) WITH (fillfactor = 50);
