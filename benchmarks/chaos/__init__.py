"""Many short jobs through the real HTTP API while everything is killed, frozen and restarted at random.

``python -m benchmarks.chaos`` prints a verdict, writes it as JSON, and exits with 0 if everything held.
"""
