"""The messages between the service and its clients, defined once for both. Needs pydantic only."""
