"""Lenses as unknowns of the adjustment: what is known of them before and after, and the way back to camera models."""
