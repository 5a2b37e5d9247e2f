"""Benchmarks of speed (`make bench`), of the method, and of the service under load and chaos."""
