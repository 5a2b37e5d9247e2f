-- Functions and triggers of release 0.1, on the tables of 1_tables.sql.

-- Appends to a job's history. The row lock of the job makes seq gapless and in commit order.
CREATE FUNCTION add_job_event(_job_id text, _type text, _data jsonb) RETURNS bigint LANGUAGE plpgsql AS $$
DECLARE
    _seq bigint;
    _attempt int;
BEGIN
    UPDATE jobs SET seq = seq + 1, revision = revision + 1, updated_at = clock_timestamp()
        WHERE id = _job_id RETURNING seq, attempt INTO STRICT _seq, _attempt;
    INSERT INTO job_events (job_id, seq, attempt, type, data) VALUES (_job_id, _seq, _attempt, _type, _data);
    PERFORM pg_notify('biresnerf_jobs', _job_id);
    RETURN _seq;
END;
$$;

-- The files of a deleted job, and of its exports, are deleted too.
CREATE FUNCTION job_files_to_trash() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO trash (prefix) VALUES ('jobs/' || OLD.id);
    RETURN OLD;
END;
$$;
CREATE TRIGGER job_files_to_trash AFTER DELETE ON jobs FOR EACH ROW EXECUTE FUNCTION job_files_to_trash();

CREATE FUNCTION touch() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    NEW.touched_at = clock_timestamp();
    RETURN NEW;
END;
$$;
CREATE TRIGGER touch BEFORE UPDATE ON datasets FOR EACH ROW
    WHEN (NEW.revision <> OLD.revision) EXECUTE FUNCTION touch();

-- Exports run beside refinements and have a queue of their own: a tenant's limit neither counts nor holds them, and
-- their turns are counted among themselves.
-- Self-clocked fair queueing. A job's turn is the cost of its tenant's jobs before it, divided by the tenant's weight,
-- counted from the clock; the clock stands at the turn of the job that started last. So tenants that wait at the
-- same time take turns by weight, and capacity used while no other tenant waited is not held against anyone.
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
    IF NOT EXISTS (SELECT 1 FROM jobs WHERE tenant = _tenant AND held AND NOT awaits_parts AND state = 'queued') THEN
        RETURN 0;
    END IF;
    -- Of two that offer at once (a janitor, an end, a new limit) neither sees what the other offers.
    PERFORM 1 FROM tenants WHERE id = _tenant FOR NO KEY UPDATE;
    SELECT max_running INTO STRICT _limit FROM tenant_limits WHERE id = _tenant;
    SELECT CASE WHEN _limit = 0 THEN 2147483647 ELSE greatest(0, _limit - count(*)) END INTO _room
        FROM jobs WHERE tenant = _tenant AND kind = 'refine' AND NOT held AND state IN ('queued', 'running');
    FOR _job IN
        -- One that is being cancelled is passed over.
        SELECT id, queue_id FROM jobs WHERE tenant = _tenant AND held AND NOT awaits_parts AND state = 'queued'
            ORDER BY queue_order, queue_id LIMIT _room FOR NO KEY UPDATE SKIP LOCKED
    LOOP
        UPDATE jobs SET held = false WHERE id = _job.id;
        PERFORM offer_queue_entry(_job.queue_id);
        _offered := _offered + 1;
    END LOOP;
    RETURN _offered;
END;
$$;
-- A submission that counts a job which is just ending is held, and the end does not see it. So, where there is a limit,
-- an end comes before the submission or after it.
CREATE FUNCTION make_room() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF (SELECT max_running FROM tenant_limits WHERE id = NEW.tenant) > 0 THEN
        PERFORM 1 FROM tenants WHERE id = NEW.tenant FOR NO KEY UPDATE;
    END IF;
    PERFORM offer_held(NEW.tenant);
    RETURN NULL;
END;
$$;
-- Locked last, once all ends are written: who ends several jobs in one transaction (a janitor) would lock the tenant at
-- the first, and then wait for the next job, whose worker holds it and waits for the tenant.
CREATE CONSTRAINT TRIGGER make_room AFTER UPDATE OF state ON jobs DEFERRABLE INITIALLY DEFERRED FOR EACH ROW
    WHEN (OLD.state IN ('queued', 'running') AND NEW.state NOT IN ('queued', 'running'))
    EXECUTE FUNCTION make_room();

-- Adds up what an attempt used, once: when its job stops running, or begins another attempt while the end of this one was
-- never written. An attempt without an end of its own (its token is gone, or another's) counts until it was last seen.
-- An export runs beside the refinement that has the slot's device. Metrics name the first 100 tenants.
CREATE FUNCTION add_use() RETURNS trigger LANGUAGE plpgsql AS $$
DECLARE
    _lost boolean := NEW.run_token IS NULL OR NEW.attempt > OLD.attempt;
    _wall_s double precision := greatest(0, extract(epoch FROM
        CASE WHEN _lost THEN OLD.attempt_seen_at ELSE clock_timestamp() END - OLD.attempt_started_at));
    _device text := CASE WHEN OLD.kind = 'refine' AND OLD.slot_kind = 'gpu' THEN 'gpu' ELSE 'cpu' END;
    _gpu_s double precision := CASE _device WHEN 'gpu' THEN _wall_s ELSE 0 END;
    _label text := CASE WHEN (SELECT count(*) FROM tenants, (SELECT created_at, id FROM tenants WHERE id = OLD.tenant) AS own
        WHERE (tenants.created_at, tenants.id) < (own.created_at, own.id)) < 100 THEN OLD.tenant ELSE '(others)' END;
BEGIN
    NEW.processor_s := OLD.processor_s + OLD.attempt_processor_s;
    NEW.wall_s := OLD.wall_s + _wall_s;
    NEW.gpu_s := OLD.gpu_s + _gpu_s;
    INSERT INTO use_records (tenant, key_id, device, processor_s, wall_s)
        VALUES (OLD.tenant, coalesce(OLD.key_id, ''), _device, OLD.attempt_processor_s, _wall_s);
    INSERT INTO tally_log (name, label, amount) VALUES ('processor_seconds', _label, OLD.attempt_processor_s),
        ('wall_seconds', _label, _wall_s), ('gpu_seconds', _label, _gpu_s);
    RETURN NEW;
END;
$$;
CREATE TRIGGER add_use BEFORE UPDATE OF state ON jobs FOR EACH ROW
    WHEN (OLD.state = 'running' AND (NEW.state <> 'running' OR NEW.attempt > OLD.attempt)) EXECUTE FUNCTION add_use();

-- Seconds that a tenant's jobs have run today (UTC), those that run now included.
CREATE FUNCTION seconds_today(_tenant text) RETURNS double precision LANGUAGE sql AS $$
    SELECT (SELECT coalesce(sum(wall_s), 0) FROM use_records
            WHERE tenant = _tenant AND day = (clock_timestamp() AT TIME ZONE 'UTC')::date)
        + (SELECT coalesce(sum(extract(epoch FROM clock_timestamp() - attempt_started_at)), 0)::float8 FROM jobs
            WHERE tenant = _tenant AND state = 'running')
$$;

-- What a tenant has stored: files of datasets, results, and of uploads what their datasets do not count yet.
CREATE FUNCTION count_stored_bytes() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    UPDATE datasets SET stored_bytes = stored_bytes - OLD.size WHERE id = OLD.dataset_id;
    UPDATE datasets SET stored_bytes = stored_bytes + NEW.size WHERE id = NEW.dataset_id;
    RETURN NULL;
END;
$$;
CREATE TRIGGER count_stored_bytes AFTER UPDATE OF size, dataset_id ON dataset_files
    FOR EACH ROW EXECUTE FUNCTION count_stored_bytes();
-- Counted once for all files of a statement: an archive records thousands at once.
CREATE FUNCTION count_changed_bytes() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    UPDATE datasets SET stored_bytes = stored_bytes + CASE TG_OP WHEN 'INSERT' THEN total.bytes ELSE -total.bytes END
        FROM (SELECT dataset_id, sum(size)::bigint AS bytes FROM changed GROUP BY dataset_id) AS total
        WHERE id = total.dataset_id;
    RETURN NULL;
END;
$$;
CREATE TRIGGER count_added_bytes AFTER INSERT ON dataset_files REFERENCING NEW TABLE AS changed
    FOR EACH STATEMENT EXECUTE FUNCTION count_changed_bytes();
CREATE TRIGGER count_deleted_bytes AFTER DELETE ON dataset_files REFERENCING OLD TABLE AS changed
    FOR EACH STATEMENT EXECUTE FUNCTION count_changed_bytes();
CREATE FUNCTION stored_bytes_of(_tenant text) RETURNS bigint LANGUAGE sql AS $$
    SELECT (SELECT coalesce(sum(stored_bytes), 0) FROM datasets WHERE tenant = _tenant)::bigint
        + (SELECT coalesce(sum(stored_bytes), 0) FROM jobs WHERE tenant = _tenant)::bigint
        + (SELECT coalesce(sum(uploads.size - uploads.brought), 0) FROM uploads
            JOIN datasets ON datasets.id = uploads.dataset_id
            WHERE datasets.tenant = _tenant AND uploads.state IN ('receiving', 'received'))::bigint
$$;

CREATE FUNCTION rfc3339(_at timestamptz) RETURNS text LANGUAGE sql STABLE AS $$
    SELECT to_char(_at AT TIME ZONE 'UTC', 'YYYY-MM-DD"T"HH24:MI:SS.US"Z"')
$$;

-- One message for each webhook of the tenant that wants the event; behind 1000 that wait it has failed at once. `_about` is the job or batch; none where it is about neither.
CREATE FUNCTION queue_webhooks(_tenant text, _about text, _event text, _at timestamptz, _data jsonb)
RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO webhook_deliveries (id, webhook_id, event, body, state, finished_at)
    SELECT 'msg_' || replace(gen_random_uuid()::text, '-', ''), hook.id, _event,
        jsonb_build_object('type', _event, 'timestamp', rfc3339(_at), 'data', _data)::text,
        CASE WHEN waiting.full THEN 'failed' ELSE 'pending' END, CASE WHEN waiting.full THEN clock_timestamp() END
    FROM webhooks AS hook CROSS JOIN LATERAL (SELECT count(*) >= 1000 AS full FROM (
        SELECT FROM webhook_deliveries WHERE webhook_id = hook.id AND state = 'pending' LIMIT 1000) AS first) AS waiting
    WHERE hook.tenant = _tenant AND hook.enabled AND _event = ANY (hook.events)
        AND (coalesce(hook.job_id, hook.batch_id) IS NULL OR coalesce(hook.job_id, hook.batch_id) = _about);
    IF FOUND THEN
        PERFORM pg_notify('biresnerf_webhooks', '');
    END IF;
END;
$$;

CREATE FUNCTION tell_of_job() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM queue_webhooks(tenant, id, 'job.' || NEW.type, NEW.at, jsonb_build_object(
        'id', id, 'kind', kind, 'parent', parent, 'dataset_id', dataset_id, 'state', state, 'attempt', attempt, 'verdict', verdict,
        'error', error - 'log_tail', 'labels', labels, 'created_at', rfc3339(created_at),
        'started_at', rfc3339(started_at), 'finished_at', rfc3339(finished_at),
        'links', jsonb_build_object('self', '/v1/jobs/' || id, 'report', '/v1/jobs/' || id || '/report',
            'artifacts', '/v1/jobs/' || id || '/artifacts')))
    FROM jobs WHERE id = NEW.job_id AND (kind <> 'refine' OR parent IS NULL);  -- what a split job tells is enough
    RETURN NULL;
END;
$$;
CREATE TRIGGER tell_of_job AFTER INSERT ON job_events FOR EACH ROW
    WHEN (NEW.type IN ('queued', 'started', 'succeeded', 'failed', 'cancelled', 'expired'))
    EXECUTE FUNCTION tell_of_job();

-- The end of a batch is written and told once, whichever of its jobs ends last and however: ends in a tenant's batches
-- come one after the other, and each sees those before it. The tenant is locked last, as in make_room().
CREATE FUNCTION close_batch() RETURNS trigger LANGUAGE plpgsql AS $$
DECLARE
    _batch batches;
BEGIN
    PERFORM 1 FROM tenants WHERE id = NEW.tenant FOR NO KEY UPDATE;
    UPDATE batches SET finished_at = clock_timestamp() WHERE id = NEW.batch_id AND finished_at IS NULL AND NOT EXISTS (
        SELECT FROM jobs WHERE batch_id = NEW.batch_id AND state IN ('queued', 'running')) RETURNING * INTO _batch;
    IF FOUND THEN
        PERFORM queue_webhooks(_batch.tenant, _batch.id, 'batch.finished', _batch.finished_at, jsonb_build_object(
            'id', _batch.id, 'created_at', rfc3339(_batch.created_at), 'finished_at', rfc3339(_batch.finished_at),
            'counts', (SELECT jsonb_object_agg(state, jobs) FROM (
                SELECT state, count(*) AS jobs FROM jobs WHERE batch_id = _batch.id GROUP BY state) AS counted),
            'links', jsonb_build_object('self', '/v1/batches/' || _batch.id)));
    END IF;
    RETURN NULL;
END;
$$;
CREATE CONSTRAINT TRIGGER close_batch AFTER UPDATE OF state ON jobs DEFERRABLE INITIALLY DEFERRED FOR EACH ROW
    WHEN (NEW.batch_id IS NOT NULL AND OLD.state IN ('queued', 'running') AND NEW.state NOT IN ('queued', 'running'))
    EXECUTE FUNCTION close_batch();

-- A batch goes with its last job. Of two that are deleted at once, the second sees that the first is gone.
CREATE FUNCTION drop_batch() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM 1 FROM batches WHERE id = OLD.batch_id FOR UPDATE;
    DELETE FROM batches WHERE id = OLD.batch_id AND NOT EXISTS (SELECT FROM jobs WHERE batch_id = OLD.batch_id);
    RETURN NULL;
END;
$$;
CREATE TRIGGER drop_batch AFTER DELETE ON jobs FOR EACH ROW WHEN (OLD.batch_id IS NOT NULL)
    EXECUTE FUNCTION drop_batch();

CREATE FUNCTION tell_of_dataset() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM queue_webhooks(NEW.tenant, NULL, 'dataset.validated', clock_timestamp(), jsonb_build_object(
        'id', NEW.id, 'name', NEW.name, 'state', NEW.state, 'error', NEW.error - 'log_tail',
        'created_at', rfc3339(NEW.created_at),
        'links', jsonb_build_object('self', '/v1/datasets/' || NEW.id)));
    RETURN NULL;
END;
$$;
CREATE TRIGGER tell_of_dataset AFTER UPDATE OF state ON datasets FOR EACH ROW
    WHEN (OLD.state = 'finalizing' AND NEW.state IN ('ready', 'rejected'))
    EXECUTE FUNCTION tell_of_dataset();

-- Upper bounds of the buckets that durations are sorted into, in seconds.
CREATE FUNCTION tally_bounds() RETURNS double precision[] LANGUAGE sql IMMUTABLE AS $$
    SELECT ARRAY[0.5, 1, 2, 5, 10, 20, 60, 120, 300, 600, 1200, 1800, 3600, 7200]::double precision[]
$$;

CREATE FUNCTION tally_seconds(_name text, _label text, _seconds double precision) RETURNS void LANGUAGE sql AS $$
    INSERT INTO tally_log (name, label, bucket, amount)
        VALUES (_name, _label, width_bucket(greatest(_seconds, 0), tally_bounds()), greatest(_seconds, 0))
$$;

-- Only these end a stage: previews and checkpoints fall into the middle of one.
CREATE FUNCTION tally_job_event() RETURNS trigger LANGUAGE plpgsql AS $$
DECLARE
    _marks text[] := '{started,stage,attempt_crashed,retried_smaller,requeued,succeeded,failed,cancelled,expired}';
    _created timestamptz;
    _before record;
BEGIN
    INSERT INTO tally_log (name, label) VALUES ('job_events', NEW.type);
    IF NEW.type <> ALL (_marks) THEN
        RETURN NULL;
    END IF;
    IF NEW.type = 'failed' THEN
        INSERT INTO tally_log (name, label) VALUES ('job_failures', coalesce(NEW.data ->> 'code', ''));
    ELSIF NEW.type = 'requeued' THEN
        INSERT INTO tally_log (name, label) VALUES ('job_requeues', coalesce(NEW.data ->> 'why', ''));
    END IF;
    SELECT type, data ->> 'stage' AS stage, at INTO _before FROM job_events
        WHERE job_id = NEW.job_id AND seq < NEW.seq AND type = ANY (_marks) ORDER BY seq DESC LIMIT 1;
    IF FOUND AND _before.type = 'stage' THEN
        PERFORM tally_seconds('stage_seconds', coalesce(_before.stage, ''), extract(epoch FROM NEW.at - _before.at));
    END IF;
    IF NEW.type IN ('started', 'succeeded', 'failed', 'cancelled', 'expired') THEN
        SELECT created_at INTO _created FROM jobs WHERE id = NEW.job_id;
        IF NEW.type <> 'started' THEN
            PERFORM tally_seconds('job_seconds', NEW.type, extract(epoch FROM NEW.at - _created));
        ELSIF NOT EXISTS (
            SELECT FROM job_events WHERE job_id = NEW.job_id AND seq < NEW.seq AND type = 'started'
        ) THEN
            PERFORM tally_seconds('queue_wait_seconds', '', extract(epoch FROM NEW.at - _created));
        END IF;
    END IF;
    RETURN NULL;
END;
$$;
CREATE TRIGGER tally_job_event AFTER INSERT ON job_events FOR EACH ROW EXECUTE FUNCTION tally_job_event();

-- Whichever way the bytes came: through the API, in parts, or straight to the store.
CREATE FUNCTION tally_stored() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO tally_log (name, amount) VALUES ('stored_files', 1), ('stored_bytes', NEW.size);
    RETURN NULL;
END;
$$;
CREATE TRIGGER tally_stored AFTER INSERT OR UPDATE OF key ON dataset_files
    FOR EACH ROW EXECUTE FUNCTION tally_stored();

CREATE FUNCTION tally_webhook_attempt() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO tally_log (name, label) VALUES ('webhook_attempts',
        CASE WHEN NEW.error IS NULL AND NEW.status BETWEEN 200 AND 299 THEN 'delivered' ELSE 'failed' END);
    RETURN NULL;
END;
$$;
CREATE TRIGGER tally_webhook_attempt AFTER INSERT ON webhook_attempts
    FOR EACH ROW EXECUTE FUNCTION tally_webhook_attempt();
