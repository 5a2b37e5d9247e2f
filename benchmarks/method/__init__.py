"""How well poses are found: seeding, the photometric loss and the verdict's trainings."""
