"""Generic estimation: robust losses, sampling consensus, batched damped least squares.

Knows arrays and callables; nothing of events, lines or files.
"""
