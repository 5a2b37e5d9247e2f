"""Repairs cameras that are far off. Finding them is `optimise`'s part."""
