"""Poses in plain tables and XML: TUM, KITTI, LLFF, Bundler, Metashape."""
