"""Claims into tables: scenes of known poses, noise, seeds and variants of the options; each run measured alone."""
