"""Long work outside the serving process: supervised children, progress, cancel.

Rows in the store are the truth; a child is started, watched and ended, never asked.
"""
