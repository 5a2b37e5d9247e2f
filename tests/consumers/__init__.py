"""Our files in other programs' own readers, in a separate environment."""
