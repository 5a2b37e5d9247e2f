"""Speed and memory under load: a full queue, many uploads, many listeners, an hour of requests.

``python -m benchmarks.load`` prints a table and writes it as JSON.
"""
