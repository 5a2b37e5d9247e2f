"""Cameras on Earth: WGS84, local axes, and which similarity carries cameras to measured positions."""
