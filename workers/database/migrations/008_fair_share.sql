-- Fair shares between tenants, and their limits. 0 is no limit.

-- What holds for tenants that have nothing else in their row; the web process writes it from its settings.
CREATE TABLE tenant_defaults (
    one boolean PRIMARY KEY DEFAULT true CHECK (one),
    max_running int NOT NULL DEFAULT 0,
    max_queued int NOT NULL DEFAULT 0,
    max_stored_bytes bigint NOT NULL DEFAULT 0
);
INSERT INTO tenant_defaults DEFAULT VALUES;
ALTER TABLE tenants DROP CONSTRAINT tenants_max_running_check, ADD CHECK (max_running >= 0);
-- Whoever runs the machine knows what else runs on it.
UPDATE tenants SET max_running = 0, max_queued = 0, max_stored_bytes = 0 WHERE id = 'local';
CREATE VIEW tenant_limits AS
    SELECT tenants.id, tenants.weight, tenants.top_priority,
        coalesce(tenants.max_running, usual.max_running) AS max_running,
        coalesce(tenants.max_queued, usual.max_queued) AS max_queued,
        coalesce(tenants.max_stored_bytes, usual.max_stored_bytes) AS max_stored_bytes
    FROM tenants CROSS JOIN tenant_defaults AS usual;

-- Self-clocked fair queueing. A job's turn is what its tenant's jobs before it cost, over the tenant's weight,
-- counted from the clock; the clock stands at the turn of the job that started last. So tenants that wait at the
-- same time take turns by weight, and what one used while nobody else waited is not held against it.
CREATE TABLE fair_clock (
    priority smallint PRIMARY KEY,
    turn double precision NOT NULL DEFAULT 0
);
INSERT INTO fair_clock (priority) VALUES (-1), (0), (1);

-- `queue_order`: priority first, then turn; lower runs earlier. `held`: the tenant has as many jobs before the
-- queue as it may; the queue does not offer this one until one of those ends.
ALTER TABLE jobs
    ADD COLUMN priority smallint NOT NULL DEFAULT 0 CHECK (priority BETWEEN -1 AND 1),
    ADD COLUMN turn double precision NOT NULL DEFAULT 0,
    ADD COLUMN queue_order int NOT NULL DEFAULT 0,
    ADD COLUMN held boolean NOT NULL DEFAULT false;
CREATE INDEX jobs_waiting ON jobs (queue_order, queue_id) WHERE state = 'queued';
CREATE INDEX jobs_waiting_of_tenant ON jobs (tenant, priority, turn) WHERE state = 'queued';
CREATE INDEX jobs_held ON jobs (tenant, queue_order, queue_id) WHERE held AND state = 'queued';
CREATE INDEX jobs_offered ON jobs (tenant) WHERE NOT held AND state IN ('queued', 'running');

CREATE FUNCTION give_turn() RETURNS trigger LANGUAGE plpgsql AS $$
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
    _cost := least(10, greatest(0.1, coalesce((NEW.options ->> 'steps')::double precision, 800) / 8000));
    NEW.turn := _cost / _tenant.weight + greatest(_clock, (
        SELECT max(turn) FROM jobs WHERE tenant = NEW.tenant AND priority = NEW.priority AND state = 'queued'));
    NEW.queue_order := -700000000 * NEW.priority + least(699999999, 100 * NEW.turn)::int;
    NEW.held := _tenant.max_running > 0 AND _tenant.max_running <= (
        SELECT count(*) FROM jobs WHERE tenant = NEW.tenant AND NOT held AND state IN ('queued', 'running'));
    RETURN NEW;
END;
$$;
CREATE TRIGGER give_turn BEFORE INSERT ON jobs FOR EACH ROW EXECUTE FUNCTION give_turn();

CREATE FUNCTION move_clock() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    UPDATE fair_clock SET turn = NEW.turn WHERE priority = NEW.priority AND turn < NEW.turn;
    RETURN NULL;
END;
$$;
CREATE TRIGGER move_clock AFTER UPDATE OF state ON jobs FOR EACH ROW
    WHEN (OLD.state = 'queued' AND NEW.state = 'running') EXECUTE FUNCTION move_clock();

-- Lets held jobs of a tenant before the queue as far as its limit allows; returns how many.
CREATE FUNCTION offer_held(_tenant text) RETURNS int LANGUAGE plpgsql AS $$
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
        FROM jobs WHERE tenant = _tenant AND NOT held AND state IN ('queued', 'running');
    FOR _job IN
        -- One that is being cancelled is passed over.
        SELECT id, queue_id FROM jobs WHERE tenant = _tenant AND held AND state = 'queued'
            ORDER BY queue_order, queue_id LIMIT _room FOR NO KEY UPDATE SKIP LOCKED
    LOOP
        UPDATE jobs SET held = false WHERE id = _job.id;
        UPDATE procrastinate_jobs SET scheduled_at = NULL WHERE id = _job.queue_id AND status = 'todo';
        -- The queue engine notifies of new rows only.
        PERFORM pg_notify('procrastinate_queue_v1#' || queue_name,
            json_build_object('type', 'job_inserted', 'job_id', id)::text)
            FROM procrastinate_jobs WHERE id = _job.queue_id;
        _offered := _offered + 1;
    END LOOP;
    RETURN _offered;
END;
$$;
CREATE FUNCTION make_room() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM offer_held(NEW.tenant);
    RETURN NULL;
END;
$$;
CREATE TRIGGER make_room AFTER UPDATE OF state ON jobs FOR EACH ROW
    WHEN (OLD.state IN ('queued', 'running') AND NEW.state NOT IN ('queued', 'running'))
    EXECUTE FUNCTION make_room();

-- What a tenant has stored: files of datasets, uploads under way at their full size, results.
ALTER TABLE datasets ADD COLUMN stored_bytes bigint NOT NULL DEFAULT 0;
UPDATE datasets SET stored_bytes = coalesce(
    (SELECT sum(size) FROM dataset_files WHERE dataset_id = datasets.id), 0);
CREATE FUNCTION count_stored_bytes() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF TG_OP <> 'INSERT' THEN
        UPDATE datasets SET stored_bytes = stored_bytes - OLD.size WHERE id = OLD.dataset_id;
    END IF;
    IF TG_OP <> 'DELETE' THEN
        UPDATE datasets SET stored_bytes = stored_bytes + NEW.size WHERE id = NEW.dataset_id;
    END IF;
    RETURN NULL;
END;
$$;
CREATE TRIGGER count_stored_bytes AFTER INSERT OR DELETE OR UPDATE OF size, dataset_id ON dataset_files
    FOR EACH ROW EXECUTE FUNCTION count_stored_bytes();
CREATE FUNCTION bytes_of_artifacts(_artifacts jsonb) RETURNS bigint LANGUAGE sql IMMUTABLE AS $$
    SELECT coalesce(sum((item ->> 'size')::bigint), 0)::bigint FROM jsonb_array_elements(_artifacts) AS item
$$;
ALTER TABLE jobs ADD COLUMN stored_bytes bigint GENERATED ALWAYS AS (bytes_of_artifacts(artifacts)) STORED;
CREATE FUNCTION stored_bytes_of(_tenant text) RETURNS bigint LANGUAGE sql AS $$
    SELECT (SELECT coalesce(sum(stored_bytes), 0) FROM datasets WHERE tenant = _tenant)::bigint
        + (SELECT coalesce(sum(stored_bytes), 0) FROM jobs WHERE tenant = _tenant)::bigint
        + (SELECT coalesce(sum(uploads.size), 0) FROM uploads JOIN datasets ON datasets.id = uploads.dataset_id
            WHERE datasets.tenant = _tenant AND uploads.state IN ('receiving', 'received'))::bigint
$$;
