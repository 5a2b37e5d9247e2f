"""The operator's settings, and what all processes share: logs, traces, errors."""
