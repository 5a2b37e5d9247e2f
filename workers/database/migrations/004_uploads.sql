-- Who takes a received upload into its dataset, and until when that holds without a sign of life.
ALTER TABLE uploads ADD COLUMN take_token uuid, ADD COLUMN take_until timestamptz;
CREATE INDEX uploads_received ON uploads (created_at) WHERE state = 'received';
