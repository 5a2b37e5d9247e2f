"""Webhooks: kept, signed, sent."""
