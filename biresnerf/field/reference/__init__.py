"""The field in plain torch, written to be read: it defines what the fast backends compute."""
