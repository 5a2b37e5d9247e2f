"""Feature matches, tracks, and points triangulated from them. Moves no camera."""
