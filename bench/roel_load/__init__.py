"""Load on a running server, measured from outside: a client and a server, each in its process."""
