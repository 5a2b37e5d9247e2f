"""What all routes share: access, limits, errors, request logs and metrics."""
