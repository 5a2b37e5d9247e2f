"""How well poses are found: seeding, lenses and the verdict's trainings."""
