-- What the refinement said of its own result; none before the end, and where no verdict was asked for.
ALTER TABLE jobs ADD COLUMN verdict text;
