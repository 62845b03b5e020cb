"""What the server remembers: rows in SQLite, recordings and maps as files.

Knows neither protobuf nor algorithms.
"""
