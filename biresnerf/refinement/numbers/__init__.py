"""The numbers that decide what a run does, by package, each with its unit and reason; the method holds them."""
