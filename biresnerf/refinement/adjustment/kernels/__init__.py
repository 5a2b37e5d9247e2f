"""The adjustment's inner loops, compiled. `reference` defines what they compute; nothing here decides anything."""
