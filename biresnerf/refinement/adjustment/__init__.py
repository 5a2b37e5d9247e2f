"""All cameras adjusted at once, to tracks and to patches of the photos. Does not know where either comes from."""
