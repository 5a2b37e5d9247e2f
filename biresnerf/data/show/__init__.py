"""Pictures and files for looking at a result: renders, thumbnails, view.json, the training curve. Decides nothing."""
