"""Stage 1, the switch, stage 2: when they end, what is recorded, and checkpoints."""
