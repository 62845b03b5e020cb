"""Synthetic recordings with ground truth: rooms, motion, event sensor, panoramas.

Out: a folder that the readers of `io` read like any recording. Deterministic by seed.
"""
