"""What the whole service does under outages, broken uploads and parallel jobs, and what its page weighs."""
