"""HTTP for every route alike: access, limits, errors, logs and metrics of requests."""
