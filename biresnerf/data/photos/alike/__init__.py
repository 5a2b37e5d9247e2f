"""How alike whole photos are: which show the same, which are copies, and whether an object turned."""
