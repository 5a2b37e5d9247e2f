"""A 3-D view of a result, or of a run in progress, in a browser, by viser. Reads files only; no torch."""
