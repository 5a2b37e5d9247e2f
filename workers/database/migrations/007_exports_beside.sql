-- Exports run beside refinements and have a queue of their own: a tenant's limit neither counts nor holds them, and
-- their turns are counted among themselves. Entries of exports that wait already stay where they are.
CREATE OR REPLACE FUNCTION give_turn() RETURNS trigger LANGUAGE plpgsql AS $$
DECLARE
    _tenant tenant_limits;
    _clock double precision;
    _cost double precision;
BEGIN
    -- Submissions of one tenant come one after the other. (No FOR UPDATE: references to the row need not wait.)
    PERFORM 1 FROM tenants WHERE id = NEW.tenant FOR NO KEY UPDATE;
    SELECT * INTO STRICT _tenant FROM tenant_limits WHERE id = NEW.tenant;
    SELECT turn INTO STRICT _clock FROM fair_clock WHERE priority = NEW.priority;
    IF _clock > 1e6 AND NOT EXISTS (SELECT 1 FROM jobs WHERE state = 'queued' AND priority = NEW.priority) THEN
        -- Nobody's turn is counted from it: begin again, long before the numbers become too large.
        UPDATE fair_clock SET turn = 0 WHERE priority = NEW.priority;
        _clock := 0;
    END IF;
    -- The work of a job with the preset balanced (8000 steps) is 1; a job is never for nothing.
    _cost := least(10, greatest(0.1, coalesce(NEW.planned_steps, 800) / 8000.0));
    NEW.turn := _cost / _tenant.weight + greatest(_clock, (
        SELECT max(turn) FROM jobs WHERE tenant = NEW.tenant AND priority = NEW.priority AND kind = NEW.kind
            AND state = 'queued'));
    NEW.queue_order := -700000000 * NEW.priority + least(699999999, 100 * NEW.turn)::int;
    NEW.held := NEW.kind = 'refine' AND _tenant.max_running > 0 AND _tenant.max_running <= (
        SELECT count(*) FROM jobs
            WHERE tenant = NEW.tenant AND kind = 'refine' AND NOT held AND state IN ('queued', 'running'));
    RETURN NEW;
END;
$$;

CREATE OR REPLACE FUNCTION offer_held(_tenant text) RETURNS int LANGUAGE plpgsql AS $$
DECLARE
    _limit int;
    _room int;
    _offered int := 0;
    _job record;
BEGIN
    IF NOT EXISTS (SELECT 1 FROM jobs WHERE tenant = _tenant AND held AND state = 'queued') THEN
        RETURN 0;
    END IF;
    -- Of two that offer at once (a janitor, an end, a new limit) neither sees what the other offers.
    PERFORM 1 FROM tenants WHERE id = _tenant FOR NO KEY UPDATE;
    SELECT max_running INTO STRICT _limit FROM tenant_limits WHERE id = _tenant;
    SELECT CASE WHEN _limit = 0 THEN 2147483647 ELSE greatest(0, _limit - count(*)) END INTO _room
        FROM jobs WHERE tenant = _tenant AND kind = 'refine' AND NOT held AND state IN ('queued', 'running');
    FOR _job IN
        -- One that is being cancelled is passed over.
        SELECT id, queue_id FROM jobs WHERE tenant = _tenant AND held AND state = 'queued'
            ORDER BY queue_order, queue_id LIMIT _room FOR NO KEY UPDATE SKIP LOCKED
    LOOP
        UPDATE jobs SET held = false WHERE id = _job.id;
        PERFORM offer_queue_entry(_job.queue_id);
        _offered := _offered + 1;
    END LOOP;
    RETURN _offered;
END;
$$;

WITH free AS (UPDATE jobs SET held = false WHERE kind = 'export' AND held AND state = 'queued' RETURNING queue_id)
SELECT offer_queue_entry(queue_id) FROM free;

-- Whether a slot is busy: exports do not count.
CREATE VIEW running_refinements AS SELECT queue_id FROM jobs WHERE kind = 'refine' AND state = 'running';
