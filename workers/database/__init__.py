"""PostgreSQL: connections, schema, the private server, notifications. Knows no table but its own."""
