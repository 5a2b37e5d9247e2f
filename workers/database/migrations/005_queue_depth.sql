-- How much work waits, for autoscalers and monitoring. Names and columns of the view queue_depth are kept: what runs
-- outside of this program reads it (docs/operations.md). A role needs no other right than SELECT on it.
ALTER TABLE slots
    ADD COLUMN kind text GENERATED ALWAYS AS (CASE WHEN name LIKE 'gpu%' THEN 'gpu' ELSE 'cpu' END) STORED;
-- Of the slot that runs the job, or ran it last.
ALTER TABLE jobs ADD COLUMN slot_kind text;

-- A slot of any kind takes any job, so that `waiting`, `held` and `oldest_s` are the same for each kind.
-- `held` jobs wait for their tenant's limit: no further slot would be given one.
CREATE VIEW queue_depth AS
    SELECT kinds.slot_kind,
        count(*) FILTER (WHERE job.state = 'queued' AND NOT job.held) AS waiting,
        count(*) FILTER (WHERE job.state = 'queued' AND job.held) AS held,
        count(*) FILTER (
            WHERE job.state = 'running' AND coalesce(job.slot_kind, 'cpu') = kinds.slot_kind) AS running,
        greatest(coalesce(extract(epoch FROM clock_timestamp()
            - min(job.created_at) FILTER (WHERE job.state = 'queued' AND NOT job.held)), 0), 0)::float8 AS oldest_s
    FROM (VALUES ('cpu'), ('gpu')) AS kinds (slot_kind)
    LEFT JOIN jobs AS job ON job.state IN ('queued', 'running')
    GROUP BY kinds.slot_kind ORDER BY kinds.slot_kind;
