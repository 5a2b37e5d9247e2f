"""What the operator sets, and what every process has: logs, traces, errors."""
