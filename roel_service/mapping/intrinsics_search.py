"""The focal length and the principal point under which lines and poses of a recording cost least.

Everything is done anew with calibrations that differ by per cents of the focal length, from the events
on: lines are found, matched and refined with the poses. What they cost then is nearly a parabola; where
it is least, how much it bends and how far the single costs lie off it tell what is wrong with the
calibration and how surely it is known. One number is looked for after the other, with the ones before
it applied, and all of them again if any was: each one's error shifts the others.

Paper: none; the published method takes the calibration as given.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.scene.camera import Camera
from roel_service.scene.results import CalibrationOffset, IntrinsicsEstimate

# Steps between calibrations, as shares of the focal length, and how many on either side of the least
# cost are needed.
STEP, SIDE_COUNT = 0.01, 2
# A number that is given is at most so many steps off.
MAX_STEP_COUNT = 6
# All numbers are looked for so many times at the most.
MAX_PASS_COUNT = 3
# What is left with any number of observations, as a share: the costs' own errors are not all of chance.
LEAST_SIGMA = 0.0015
# Where nothing tells, a change of none, infinitely unsure.
UNKNOWN = (0.0, float("inf"))
# A number that is off by less, or less surely, stays; once a calibration is known to be off, the
# likeliest one is the best.
LEAST_CHANGE, SIGMA_COUNT = 0.005, 3.0
SIGMA_COUNT_THEN = 1.0


def estimate_intrinsics(camera: Camera, cost: Callable[[Camera], float]) -> IntrinsicsEstimate:
    """What is wrong with the focal length and the principal point.

    Args:
        camera: as it was given.
        cost: of a recording with a calibration, in units of its noise (twice a negative logarithm of a
            likelihood).
    """
    cost = functools.cache(cost)
    given = camera
    for _ in range(MAX_PASS_COUNT):
        before = camera
        focal, camera = _mended(given, camera, FOCAL, cost)
        principal_x, camera = _mended(given, camera, PRINCIPAL_X, cost)
        principal_y, camera = _mended(given, camera, PRINCIPAL_Y, cost)
        if camera == before:
            break
    return IntrinsicsEstimate(
        focal=focal, principal_x=principal_x, principal_y=principal_y, camera=camera
    )


def with_focal(camera: Camera, share: float) -> Camera:
    """A camera with focal lengths that are longer by a share."""
    return replace(camera, fx_px=(1.0 + share) * camera.fx_px, fy_px=(1.0 + share) * camera.fy_px)


def with_principal_x(camera: Camera, shift_px: float) -> Camera:
    """A camera with its principal point further to the right."""
    return replace(camera, cx_px=camera.cx_px + shift_px)


def with_principal_y(camera: Camera, shift_px: float) -> Camera:
    """A camera with its principal point further down."""
    return replace(camera, cy_px=camera.cy_px + shift_px)


@dataclass(frozen=True)
class _Number:
    """One number of a calibration.

    Attributes:
        changed: a camera with a change of it.
        between: the change from one camera to another.
        unit: the change that goes with all of the focal length.
    """

    changed: Callable[[Camera, float], Camera]
    between: Callable[[Camera, Camera], float]
    unit: Callable[[Camera], float]


FOCAL = _Number(with_focal, lambda one, other: other.fx_px / one.fx_px - 1.0, lambda _: 1.0)
PRINCIPAL_X = _Number(
    with_principal_x, lambda one, other: other.cx_px - one.cx_px, lambda camera: camera.fx_px
)
PRINCIPAL_Y = _Number(
    with_principal_y, lambda one, other: other.cy_px - one.cy_px, lambda camera: camera.fy_px
)


def _mended(
    given: Camera, camera: Camera, number: _Number, cost: Callable[[Camera], float]
) -> tuple[CalibrationOffset, Camera]:
    """What is wrong with one number of the given camera, and a mended camera without that."""
    unit = number.unit(camera)
    share, sigma = least_cost(lambda share: cost(number.changed(camera, share * unit)))
    likeliest = number.changed(camera, share * unit)
    least = max(LEAST_CHANGE, SIGMA_COUNT * sigma) if camera == given else SIGMA_COUNT_THEN * sigma
    camera = likeliest if abs(share) > least else camera
    error = CalibrationOffset(
        change=number.between(given, likeliest),
        sigma=sigma * unit,
        is_applied=number.between(given, camera) != 0.0,
    )
    return error, camera


def least_cost(cost: Callable[[float], float]) -> tuple[float, float]:
    """The share of the focal length that has to be added to a number, and its standard deviation.

    Args:
        cost: with the number changed by a share.

    Returns:
        An infinite deviation where no change within reach is the best.
    """
    costs = {step: cost(step * STEP) for step in range(-SIDE_COUNT, SIDE_COUNT + 1)}
    while True:
        least = min(costs, key=lambda step: costs[step])
        near = range(least - SIDE_COUNT, least + SIDE_COUNT + 1)
        missing = [step for step in near if step not in costs]
        if not missing:
            break
        if max(abs(step) for step in missing) > MAX_STEP_COUNT:
            return UNKNOWN
        costs |= {step: cost(step * STEP) for step in missing}
    return _at_least_cost(least, np.array([costs[step] for step in near]))


def _at_least_cost(middle: int, costs: FloatArray) -> tuple[float, float]:
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
    return float(STEP * (middle - slope / (2.0 * bend))), float(sigma)
