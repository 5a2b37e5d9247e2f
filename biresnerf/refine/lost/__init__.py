"""Repairs cameras that are far off, and measures how certain each pose is. Finding them is `optimise`'s part."""
