-- What is counted for monitoring, in the transaction that makes it so: exact, and no process has to be asked.
-- Each count is a row of its own first, so that no two jobs wait for one another's counter; a janitor adds the
-- rows up. Deleting a job takes nothing away.
CREATE TABLE tally_log (
    name text NOT NULL,
    label text NOT NULL DEFAULT '',
    bucket smallint NOT NULL DEFAULT 0,
    amount double precision NOT NULL DEFAULT 1
);
CREATE TABLE tallies (
    name text NOT NULL,
    label text NOT NULL,
    bucket smallint NOT NULL,
    count bigint NOT NULL,
    amount double precision NOT NULL,
    PRIMARY KEY (name, label, bucket)
);

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
    _marks text[] := '{started,stage,attempt_crashed,retried_smaller,requeued,succeeded,failed,cancelled}';
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
    IF NEW.type IN ('started', 'succeeded', 'failed', 'cancelled') THEN
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

-- Which of the queue's workers is which slot, for as long as it lives.
CREATE TABLE slots (
    host text NOT NULL,
    name text NOT NULL,
    worker_id bigint NOT NULL,
    PRIMARY KEY (host, name)
);

-- Where a job's submission was traced, its attempts join that trace (W3C traceparent).
ALTER TABLE jobs ADD COLUMN trace text;
