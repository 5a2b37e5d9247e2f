-- `crashes`: attempts that crashed since the last checkpoint; `setback`: why the last attempt ended before its job did.
ALTER TABLE jobs
    ADD COLUMN crashes int NOT NULL DEFAULT 0,
    ADD COLUMN setback text
        CHECK (setback IN ('worker_lost', 'killed', 'error', 'disk_full', 'store_away'));
