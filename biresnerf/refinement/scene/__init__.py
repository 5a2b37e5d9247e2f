"""The scene, and its frame, depth and overlap as the initial cameras give them. Nothing here is optimised."""
