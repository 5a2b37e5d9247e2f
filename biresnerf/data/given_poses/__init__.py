"""Whether given poses mean what their format says: other readings of them, and which of these the photos support."""
