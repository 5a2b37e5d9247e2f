"""Made scenes whose true poses are known, for tests, demo and benchmarks."""
