"""RoEL map server: 3D line maps from event cameras.

Importing the package loads nothing heavy; import the sub-package you need.
"""

__version__ = "0.1.0"
