"""Scene files in and out: reading, validating, seeding, loading and writing image sets. Needs no torch."""
