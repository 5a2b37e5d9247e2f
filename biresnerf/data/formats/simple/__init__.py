"""Formats that one module each reads or writes: trajectories, tables, XML, poses.json, scene.glb, pinhole photos."""
