"""Files in and out: every format is read into, and written from, the types of `scene`.

Formats are told by content, not by suffix. Errors name the file, what was expected and what was
found. Nothing here imports an algorithm.
"""
