"""Finished poses as other programs read them: one file per form, and `write_packs`, which knows them all."""
