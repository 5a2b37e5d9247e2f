-- Webhooks: who hears of what, and the messages to send, written in the transaction of what they tell of.

CREATE TABLE webhooks (
    id text PRIMARY KEY,
    tenant text NOT NULL REFERENCES tenants,
    job_id text REFERENCES jobs ON DELETE CASCADE,  -- hears of this job only, and goes with it
    url text NOT NULL,
    description text NOT NULL DEFAULT '',
    events text[] NOT NULL,
    secret text NOT NULL,
    previous_secret text,
    previous_until timestamptz,
    enabled boolean NOT NULL DEFAULT true,
    disabled_why text,
    failing_since timestamptz,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp()
);
CREATE INDEX webhooks_tenant ON webhooks (tenant, created_at DESC, id DESC);
CREATE INDEX webhooks_job ON webhooks (job_id) WHERE job_id IS NOT NULL;

CREATE TABLE webhook_deliveries (
    id text PRIMARY KEY,
    webhook_id text NOT NULL REFERENCES webhooks ON DELETE CASCADE,
    event text NOT NULL,
    body text NOT NULL,
    state text NOT NULL DEFAULT 'pending' CHECK (state IN ('pending', 'delivered', 'failed')),
    attempts int NOT NULL DEFAULT 0,
    round int NOT NULL DEFAULT 0,  -- attempts since it was queued (again)
    due_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    leased_until timestamptz,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    finished_at timestamptz
);
CREATE INDEX webhook_deliveries_pending ON webhook_deliveries (due_at) WHERE state = 'pending';
CREATE INDEX webhook_deliveries_newest ON webhook_deliveries (webhook_id, created_at DESC, id DESC);

-- What came of each attempt. Of the receiver's answer only the status: its body is nobody's business here.
CREATE TABLE webhook_attempts (
    delivery_id text NOT NULL REFERENCES webhook_deliveries ON DELETE CASCADE,
    number int NOT NULL,
    at timestamptz NOT NULL,
    seconds double precision NOT NULL,
    status int,
    error text,
    PRIMARY KEY (delivery_id, number)
);

CREATE FUNCTION rfc3339(_at timestamptz) RETURNS text LANGUAGE sql STABLE AS $$
    SELECT to_char(_at AT TIME ZONE 'UTC', 'YYYY-MM-DD"T"HH24:MI:SS.US"Z"')
$$;

-- One message for each webhook of the tenant that wants the event. `_job_id` is none where it is about no job.
CREATE FUNCTION queue_webhooks(_tenant text, _job_id text, _event text, _at timestamptz, _data jsonb)
RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO webhook_deliveries (id, webhook_id, event, body)
    SELECT 'msg_' || replace(gen_random_uuid()::text, '-', ''), hook.id, _event,
        jsonb_build_object('type', _event, 'timestamp', rfc3339(_at), 'data', _data)::text
    FROM webhooks AS hook
    WHERE hook.tenant = _tenant AND hook.enabled AND _event = ANY (hook.events)
        AND (hook.job_id IS NULL OR hook.job_id = _job_id);
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
    FROM jobs WHERE id = NEW.job_id;
    RETURN NULL;
END;
$$;
CREATE TRIGGER tell_of_job AFTER INSERT ON job_events FOR EACH ROW
    WHEN (NEW.type IN ('queued', 'started', 'succeeded', 'failed', 'cancelled'))
    EXECUTE FUNCTION tell_of_job();

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
