"""Client of the RoEL map server, and the `roel` command line."""
