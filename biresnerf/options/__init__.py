"""Options of a refinement and the presets. Imports neither torch nor numpy; reads no files."""
