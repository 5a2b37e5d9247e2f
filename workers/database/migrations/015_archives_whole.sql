-- Who brings an archive into a dataset, and until when without a sign of life: closing the dataset waits.
CREATE TABLE dataset_imports (
    token uuid PRIMARY KEY,
    dataset_id text NOT NULL REFERENCES datasets ON DELETE CASCADE,
    live_until timestamptz NOT NULL
);
CREATE INDEX dataset_imports_dataset ON dataset_imports (dataset_id);

-- Counted once for all files of a statement: an archive records thousands at once, and each changed the dataset's row.
DROP TRIGGER count_stored_bytes ON dataset_files;
CREATE TRIGGER count_stored_bytes AFTER UPDATE OF size, dataset_id ON dataset_files
    FOR EACH ROW EXECUTE FUNCTION count_stored_bytes();
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
