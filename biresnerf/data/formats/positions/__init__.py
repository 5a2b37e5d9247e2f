"""Where photos were taken, as far as something beside the poses says: GPS in EXIF, tables, Metashape's references."""
