"""Pictures and files made to be looked at: renders, thumbnails, view.json. Decides nothing."""
