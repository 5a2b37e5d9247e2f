"""Slots that take jobs from the queue, their heartbeats, and the janitor that takes jobs back from dead ones."""
