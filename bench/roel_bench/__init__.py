"""Benchmarks: presets, ablations, disturbances and peers on scenes with truth, in one run."""
