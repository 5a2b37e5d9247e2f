"""Compare two results: which is better, and by what. From report.json and poses.json alone; no torch."""
