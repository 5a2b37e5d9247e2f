"""Two results against each other: which is better, and by what. From report.json and poses.json alone; no torch."""
