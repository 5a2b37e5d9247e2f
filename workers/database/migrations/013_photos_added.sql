-- The job whose result a job joins its photos to. No reference: what was joined stays when the other is deleted.
ALTER TABLE jobs ADD COLUMN fixed_from text;
CREATE INDEX jobs_fixed ON jobs (fixed_from) WHERE fixed_from IS NOT NULL;
