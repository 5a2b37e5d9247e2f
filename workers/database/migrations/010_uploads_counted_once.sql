-- What an upload brings into its dataset is counted there; of the upload itself only the rest.
ALTER TABLE uploads ADD COLUMN brought bigint NOT NULL DEFAULT 0 CHECK (brought BETWEEN 0 AND size);
CREATE OR REPLACE FUNCTION stored_bytes_of(_tenant text) RETURNS bigint LANGUAGE sql AS $$
    SELECT (SELECT coalesce(sum(stored_bytes), 0) FROM datasets WHERE tenant = _tenant)::bigint
        + (SELECT coalesce(sum(stored_bytes), 0) FROM jobs WHERE tenant = _tenant)::bigint
        + (SELECT coalesce(sum(uploads.size - uploads.brought), 0) FROM uploads
            JOIN datasets ON datasets.id = uploads.dataset_id
            WHERE datasets.tenant = _tenant AND uploads.state IN ('receiving', 'received'))::bigint
$$;
-- Who waits is counted as fast from the index of their order.
DROP INDEX jobs_queued;
