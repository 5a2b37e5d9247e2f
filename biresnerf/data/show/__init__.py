"""What is made of a result to be looked at: renders, thumbnails, view.json, the training curve. Decides nothing."""
