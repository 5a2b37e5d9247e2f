"""Job records and all SQL on them: submitting, listing, following, claiming, reporting, ending, expiring."""
