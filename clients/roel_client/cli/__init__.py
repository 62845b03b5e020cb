"""The command line `roel`.

`main` parses, checks the named files and runs the command's work in one child process, so that a
signal ends it at once and every temporary file goes with it. A command's module declares its
options and turns results into text; the work itself is called through `roel_client.local`.
Nothing here imports an algorithm: `--help` and a wrong option answer immediately.
"""
