"""Checks of the GPU code that need no GPU, and measurements that do."""
