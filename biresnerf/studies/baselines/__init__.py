"""Published methods that ours is compared with. Loaded only when a run asks for one; tables and plots are above."""
