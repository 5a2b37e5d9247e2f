"""Faults planted in the product, each of which must turn a test red: `make mutants`."""
