"""Measurements: of speed (`make bench`), of the method, of the service, under load and under chaos."""
