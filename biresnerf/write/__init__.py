"""Results, previews and partial results in the output folder. Formats are in `data.formats`."""
