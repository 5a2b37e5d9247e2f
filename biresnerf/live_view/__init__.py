"""A result, or a run under way, in three dimensions in a browser, by viser; it reads files only, and no torch."""
