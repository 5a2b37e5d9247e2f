"""Photos out of videos: which frames are worth having, and where they are written."""
