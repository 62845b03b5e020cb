"""Hand-held camera motion as a function of time, and what a visual odometry would make of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from roel_service.arrays import FloatArray, IntArray
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.geometry.vectors import unit
from roel_service.scene.trajectory import Trajectory

# A turn about the room takes this long; shorter recordings walk a part of it.
TURN_S = 7.0
# Inside a room the camera looks outwards, turned by this much, with this slope.
LOOK_AHEAD_RAD = 0.5
LOOK_DOWN = -0.18
# Hand tremor: frequencies, and standard deviations of position and direction.
TREMOR_HZ = (0.4, 3.0)
TREMOR_COUNT = 6
TREMOR_M = 0.02
TREMOR_RAD = np.deg2rad(1.2)
# Poses are written this often.
POSE_INTERVAL_US = 5_000
# A visual odometry's error: white noise of every pose, and a drift that forgets within seconds;
# per axis, so that the error of room-sized trajectories is about 7 mm and 0.33 degrees.
JITTER_M, JITTER_RAD = 0.0022, np.deg2rad(0.06)
DRIFT_M, DRIFT_RAD = 0.0045, np.deg2rad(0.25)
DRIFT_S = 1.5
# Noise of the cube's poses, per axis: an error of 0.33 units in all, as in the paper, and turns that
# move the picture as far as the shifts do.
WHITE_SHIFT, WHITE_TURN_RAD = 0.192, np.deg2rad(0.44)


@dataclass(frozen=True, eq=False, kw_only=True)
class Tremor:
    """A sum of sines in three axes: (n,) frequencies in Hz, (n, 3) amplitudes and phases."""

    frequency_hz: FloatArray
    amplitude: FloatArray
    phase_rad: FloatArray

    @staticmethod
    def draw(sigma: float, rng: np.random.Generator) -> Tremor:
        """A tremor of standard deviation `sigma` in each axis; slow waves are the largest."""
        frequency_hz = rng.uniform(*TREMOR_HZ, size=TREMOR_COUNT)
        share = rng.uniform(0.5, 1.0, size=(TREMOR_COUNT, 3)) / frequency_hz[:, None]
        share /= np.sqrt(0.5 * np.sum(share**2, axis=0))
        return Tremor(
            frequency_hz=frequency_hz,
            amplitude=sigma * share,
            phase_rad=rng.uniform(0, 2 * np.pi, size=(TREMOR_COUNT, 3)),
        )

    def at(self, t_s: FloatArray) -> FloatArray:
        """(N, 3) values at (N,) times."""
        angle = 2 * np.pi * self.frequency_hz[:, None] * t_s[:, None, None] + self.phase_rad
        return np.asarray(np.sum(self.amplitude * np.sin(angle), axis=1))


@dataclass(frozen=True, eq=False, kw_only=True)
class Motion:
    """A walk around a centre.

    The camera moves on a level ellipse and looks outwards or at a target.

    Attributes:
        centre: (3,) of the ellipse, m.
        radius_m: (2,) half axes of the ellipse.
        first_angle_rad: where the walk begins.
        target: (3,) what the camera looks at, or None to look outwards.
        shake_m, shake_rad: tremor of position and direction.
    """

    centre: FloatArray
    radius_m: FloatArray
    first_angle_rad: float
    target: FloatArray | None
    shake_m: Tremor
    shake_rad: Tremor

    def poses(self, t_us: IntArray) -> SE3:
        """(N) `T_world_camera` at (N,) times."""
        t_s = np.asarray(t_us * 1e-6, dtype=np.float64)
        angle = self.first_angle_rad + 2 * np.pi * t_s / TURN_S
        around = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
        position = self.centre + around * np.append(self.radius_m, 0.0) + self.shake_m.at(t_s)
        if self.target is None:
            # Ahead of the walk, and a little downwards, where the furniture is.
            ahead = angle + LOOK_AHEAD_RAD
            look = np.stack([np.cos(ahead), np.sin(ahead), np.full_like(ahead, LOOK_DOWN)], -1)
        else:
            look = self.target - position
        R = rotation_from_vector(self.shake_rad.at(t_s)) @ looking_along(look)
        return SE3(rotation=R, translation=position)

    def trajectory(self, duration_us: int) -> Trajectory:
        """Poses from 0 to at least `duration_us`."""
        t_us = np.arange(0, duration_us + POSE_INTERVAL_US, POSE_INTERVAL_US)
        return Trajectory(t_us=t_us, T_world_camera=self.poses(t_us))


def walk_in_room(bounds_m: FloatArray, rng: np.random.Generator) -> Motion:
    """A walk around the middle of a room, at the height of a hand.

    Args:
        bounds_m: (2, 3) lower and upper corner.
        rng: draws start, radius and tremor.
    """
    size_m = bounds_m[1] - bounds_m[0]
    scale = float(size_m[:2].min()) / 4.5
    height_m = bounds_m[0, 2] + 0.52 * size_m[2]
    return Motion(
        centre=np.append(bounds_m[:, :2].mean(axis=0), height_m),
        radius_m=rng.uniform(0.14, 0.2, size=2) * size_m[:2],
        first_angle_rad=rng.uniform(0, 2 * np.pi),
        target=None,
        shake_m=Tremor.draw(TREMOR_M * scale, rng),
        shake_rad=Tremor.draw(TREMOR_RAD, rng),
    )


def walk_around(distance: float, rng: np.random.Generator) -> Motion:
    """A walk around the origin at a distance, seen from above."""
    height = 0.45 * distance
    flat = np.sqrt(distance**2 - height**2)
    return Motion(
        centre=np.array([0.0, 0.0, height]),
        radius_m=np.full(2, flat),
        first_angle_rad=rng.uniform(0, 2 * np.pi),
        target=np.zeros(3),
        shake_m=Tremor.draw(TREMOR_M * distance, rng),
        shake_rad=Tremor.draw(TREMOR_RAD, rng),
    )


def looking_along(look: FloatArray) -> FloatArray:
    """(N, 3, 3) upright rotations `R_world_camera` whose optical axes point along (N, 3) vectors."""
    forward = unit(look)
    right = unit(np.cross(forward, [0.0, 0.0, 1.0]))
    return np.stack([right, np.cross(forward, right), forward], axis=-1)


def as_odometry(trajectory: Trajectory, scale: float, rng: np.random.Generator) -> Trajectory:
    """The trajectory with the drift and jitter of a visual odometry.

    Args:
        trajectory: true poses.
        scale: of the position error, in units of a room.
        rng: draws the error.
    """
    count = len(trajectory)
    jitter = rng.normal(size=(count, 6)) * ([JITTER_RAD] * 3 + [JITTER_M * scale] * 3)
    keep = np.exp(-np.diff(trajectory.t_us, prepend=trajectory.t_us[0]) * 1e-6 / DRIFT_S)
    steps = rng.normal(size=(count, 6)) * ([DRIFT_RAD] * 3 + [DRIFT_M * scale] * 3)
    drift = np.empty_like(steps)
    drift[0] = steps[0]
    for i in range(1, count):
        drift[i] = keep[i] * drift[i - 1] + np.sqrt(1 - keep[i] ** 2) * steps[i]
    return Trajectory(
        t_us=trajectory.t_us, T_world_camera=trajectory.T_world_camera.retract(jitter + drift)
    )


def with_white_noise(poses: SE3, scale: float, rng: np.random.Generator) -> SE3:
    """Poses (N), each but the first off by itself, in its position and its Euler angles.

    Args:
        poses: true poses.
        scale: of the position error, in units of the paper's cube.
        rng: draws the error.
    """
    shifts = rng.normal(0.0, WHITE_SHIFT * scale, poses.translation.shape)
    turns_rad = rng.normal(0.0, WHITE_TURN_RAD, poses.translation.shape)
    shifts[0] = turns_rad[0] = 0.0
    angles_rad = Rotation.from_matrix(poses.rotation).as_euler("xyz") + turns_rad
    return SE3(
        rotation=Rotation.from_euler("xyz", angles_rad).as_matrix(),
        translation=poses.translation + shifts,
    )
