-- Losing a worker is seldom the job's fault: `losses` since the last checkpoint count apart from crashes.
ALTER TABLE jobs ADD COLUMN losses int NOT NULL DEFAULT 0;
