-- How many processes were lost while they checked the dataset: one that takes them down is not checked for ever.
ALTER TABLE datasets ADD COLUMN check_losses integer NOT NULL DEFAULT 0;
