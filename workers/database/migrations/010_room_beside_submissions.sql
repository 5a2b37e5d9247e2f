-- A submission that counts a job which is just ending is held, and the end did not see it: until a janitor came, the
-- job waited though there was room. Where there is a limit, an end now comes before the submission or after it.
CREATE OR REPLACE FUNCTION make_room() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF (SELECT max_running FROM tenant_limits WHERE id = NEW.tenant) > 0 THEN
        PERFORM 1 FROM tenants WHERE id = NEW.tenant FOR NO KEY UPDATE;
    END IF;
    PERFORM offer_held(NEW.tenant);
    RETURN NULL;
END;
$$;
