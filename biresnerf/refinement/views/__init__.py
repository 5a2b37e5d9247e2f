"""Whole views rendered and scored against photos, held-out ones included. Moves no camera but those it scores."""
