"""Sets of photos as their owners published them: what the product makes of each."""
