"""Whether refinement helped, by evidence that neither set of poses was fitted to, and the report."""
