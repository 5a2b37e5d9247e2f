-- An export needs no slot of its own while a refinement waits or runs: the slot of a refinement exports beside it.
-- Counted as a waiting job, it made autoscalers start a worker that found nothing to do; counted as a running one, it
-- hid a worker that was free.
CREATE OR REPLACE VIEW queue_depth AS
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
