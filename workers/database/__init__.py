"""PostgreSQL: connections, schema, the private server, notifications. Knows only its own tables."""
