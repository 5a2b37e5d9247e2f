-- Who ends several jobs in one transaction (a janitor) locked the tenant at the first, and then waited for the next
-- job, whose worker held it and waited for the tenant. Now the tenant is locked last, once all ends are written.
DROP TRIGGER make_room ON jobs;
CREATE CONSTRAINT TRIGGER make_room AFTER UPDATE OF state ON jobs DEFERRABLE INITIALLY DEFERRED FOR EACH ROW
    WHEN (OLD.state IN ('queued', 'running') AND NEW.state NOT IN ('queued', 'running'))
    EXECUTE FUNCTION make_room();
