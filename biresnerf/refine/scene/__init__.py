"""The scene's frame, depth and overlap, as the cameras tell them. Nothing here is optimised."""
