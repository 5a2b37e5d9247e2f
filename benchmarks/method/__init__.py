"""The quality of the method: seeding, lenses, and the verdict's trainings."""
