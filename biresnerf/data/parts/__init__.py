"""Large sets in parts: cut so that each part can be refined by itself, and joined again from the parts' results."""
