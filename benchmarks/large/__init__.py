"""Sets of hundreds to thousands of photos: made, matched, adjusted."""
