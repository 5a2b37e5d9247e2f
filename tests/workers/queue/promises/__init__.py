"""A model of what the queue promises, and thousands of interleavings of real transactions to compare with it."""
