"""Where photos were taken, by data other than the poses: GPS in EXIF, tables, Metashape's references."""
