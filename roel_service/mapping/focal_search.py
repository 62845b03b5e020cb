"""The focal length under which lines and poses of a recording cost least.

Everything is done anew at focal lengths one per cent apart, from the events on: lines are found, matched
and refined with the poses. What they cost then is nearly a parabola; where it is least, how much it
bends and how far the single costs lie off it tell the focal length and how surely it is known.

Paper: none; the published method takes the calibration as given.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.scene.camera import Camera
from roel_service.scene.results import FocalEstimate

# Steps between focal lengths, as a share, and how many on either side of the least cost are needed.
STEP, SIDE_COUNT = 0.01, 2
# The given focal length is at most so many steps off.
MAX_STEP_COUNT = 6
MAX_COST_COUNT = 2 * MAX_STEP_COUNT + 1
# What is left with any number of observations, as a share: the costs' own errors are not all of chance.
LEAST_SIGMA = 0.0015
# A focal length that is off by less, or less surely, stays.
LEAST_CHANGE, SIGMA_COUNT = 0.005, 3.0
UNKNOWN = FocalEstimate(scale=1.0, sigma=float("inf"), is_applied=False)


def estimate_focal(cost: Callable[[float], float]) -> FocalEstimate:
    """What the given focal length has to be multiplied by.

    Args:
        cost: of a recording at a multiple of the given focal length, in units of its noise (twice a
            negative logarithm of a likelihood).

    Returns:
        The estimate; with an infinite deviation where no focal length within reach is the best.
    """
    costs = {step: cost(_scale(step)) for step in range(-SIDE_COUNT, SIDE_COUNT + 1)}
    while True:
        least = min(costs, key=lambda step: costs[step])
        near = range(least - SIDE_COUNT, least + SIDE_COUNT + 1)
        missing = [step for step in near if step not in costs]
        if not missing:
            break
        if max(abs(step) for step in missing) > MAX_STEP_COUNT:
            return UNKNOWN
        costs |= {step: cost(_scale(step)) for step in missing}
    return _at_least_cost(least, np.array([costs[step] for step in near]))


def with_focal(camera: Camera, scale: float) -> Camera:
    """A camera with a multiple of its focal length."""
    return replace(camera, fx_px=scale * camera.fx_px, fy_px=scale * camera.fy_px)


def _scale(step: int) -> float:
    return 1.0 + step * STEP


def _at_least_cost(middle: int, costs: FloatArray) -> FocalEstimate:
    """Where a parabola through costs around one step is least."""
    design = np.vander(np.arange(-SIDE_COUNT, SIDE_COUNT + 1.0), 3)
    (bend, slope, level), *_ = np.linalg.lstsq(design, costs, rcond=None)
    if bend <= 0.0:
        return UNKNOWN
    off = costs - design @ [bend, slope, level]
    by_coefficient = np.array([slope / (2.0 * bend**2), -1.0 / (2.0 * bend), 0.0])
    scatter = off @ off / (len(costs) - 3)
    of_scatter = scatter * by_coefficient @ np.linalg.inv(design.T @ design) @ by_coefficient
    sigma = np.hypot(STEP * np.sqrt(of_scatter + 1.0 / bend), LEAST_SIGMA)
    scale = _scale(middle) - STEP * slope / (2.0 * bend)
    is_applied = abs(scale - 1.0) > max(LEAST_CHANGE, SIGMA_COUNT * sigma)
    return FocalEstimate(scale=float(scale), sigma=float(sigma), is_applied=bool(is_applied))
