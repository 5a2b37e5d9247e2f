-- So that rounds of upkeep read what changed and lists read what they show, not all jobs that ever were: measured by
-- `python -m benchmarks.service.full_tables` (docs/scaling.md).
CREATE INDEX jobs_undated ON jobs (finished_at)
    WHERE finished_at IS NOT NULL AND expires_at IS NULL AND state <> 'expired';
CREATE INDEX jobs_with_key ON jobs (finished_at) WHERE idempotency_key IS NOT NULL;
CREATE INDEX jobs_forked ON jobs (forked_from) WHERE forked_from IS NOT NULL;
CREATE INDEX jobs_of_tenant_in_state ON jobs (tenant, state, created_at DESC, id DESC);
CREATE INDEX jobs_labels ON jobs USING gin (labels jsonb_path_ops);
CREATE INDEX datasets_touched ON datasets (touched_at);
CREATE INDEX datasets_expiry ON datasets (expires_at) WHERE expires_at IS NOT NULL;
CREATE INDEX webhook_deliveries_over ON webhook_deliveries (finished_at) WHERE finished_at IS NOT NULL;
CREATE INDEX datasets_of_state ON datasets (state);
