"""Files of datasets and captures: poses as research sets, benchmarks and phones keep them."""
