"""The commands' work in this process: the only part of the client that loads algorithms.

Each function imports what it needs when it is called, so that importing these modules costs nothing.
Files are named as the user gave them, because errors repeat the name.
"""
