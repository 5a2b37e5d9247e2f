"""The adjustment's inner loops, compiled. They are defined in plain torch beside their tests, and decide nothing."""
