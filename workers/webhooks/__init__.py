"""Webhooks and all other outgoing requests."""
