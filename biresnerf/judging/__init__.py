"""Which of two sets of poses is better: one function from paired figures to a finding, and its rules."""
