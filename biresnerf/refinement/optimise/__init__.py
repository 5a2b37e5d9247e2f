"""One step of the joint optimisation, and its schedules. When to switch stages is decided in `stages`."""
