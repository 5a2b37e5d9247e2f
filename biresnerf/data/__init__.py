"""Image sets in files: reading, checking, seeding, loading and writing them. Needs no torch; optimises nothing."""
