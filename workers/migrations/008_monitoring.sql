-- As before, but only what ends a stage does: previews and checkpoints fall into the middle of one.
CREATE OR REPLACE FUNCTION tally_job_event() RETURNS trigger LANGUAGE plpgsql AS $$
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

CREATE FUNCTION tally_webhook_attempt() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO tally_log (name, label) VALUES ('webhook_attempts',
        CASE WHEN NEW.error IS NULL AND NEW.status BETWEEN 200 AND 299 THEN 'delivered' ELSE 'failed' END);
    RETURN NULL;
END;
$$;
CREATE TRIGGER tally_webhook_attempt AFTER INSERT ON webhook_attempts
    FOR EACH ROW EXECUTE FUNCTION tally_webhook_attempt();
