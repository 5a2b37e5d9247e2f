"""Commands that work on files of this machine: refine, convert, export, inspect, evaluate ..."""
