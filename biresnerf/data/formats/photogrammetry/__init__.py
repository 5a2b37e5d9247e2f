"""Files of photogrammetry programs: OpenSfM, Meshroom, OpenMVG, RealityCapture."""
