"""Pure mathematics of poses, lines, planes and projections.

In: arrays with leading batch axes. Out: arrays of the same batch shape. float64 throughout.
Knows nothing of events, files, networks or configuration.
"""
