"""The product's results on photo sets as their owners published them."""
