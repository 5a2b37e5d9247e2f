"""What other programs read: their own readers, in an environment of their own."""
