"""Does the server keep its word when it is killed?

Checker clients upload files and recordings, build maps from them, during and after the upload, delete
some, and write down whatever the server acknowledged.
Meanwhile the server is killed: at random moments, at every named step after which something is
durable, and through its children. After each kill the data folder is checked as it lies there, and
the next server is asked for all that was acknowledged.

    python -m roel_crash --kills 210 --out crash.json
"""
