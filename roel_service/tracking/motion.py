"""A camera that moves nearly evenly: its pose, its velocity, and what is not known of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import FloatArray, frozen_array
from roel_service.config.stages import TrackConfig
from roel_service.geometry.se3 import SE3

# An acceleration lasts about so long before it is another one.
ACCELERATION_S = 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionState:
    """Pose and velocity at one time.

    Attributes:
        t_us: time.
        T_world_camera: pose.
        velocity: (6,) change (r, d) of the pose in a second, rad/s and m/s, world.
        covariance: (12, 12) of steps of the pose (r, d) and of the velocity.
    """

    t_us: int
    T_world_camera: SE3
    velocity: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        for name, shape in (("velocity", (6,)), ("covariance", (12, 12))):
            value = frozen_array(getattr(self, name), np.float64, shape, name)
            object.__setattr__(self, name, value)

    def poses(self, after_s: FloatArray) -> SE3:
        """(N) poses so many seconds after the state's time, were the motion even."""
        return self.T_world_camera.retract(np.asarray(after_s)[..., None] * self.velocity)

    def stepped(self, step: FloatArray, covariance: FloatArray) -> MotionState:
        """With pose and velocity changed by (12,), and with another covariance."""
        return MotionState(
            t_us=self.t_us,
            T_world_camera=self.T_world_camera.retract(step[:6]),
            velocity=self.velocity + step[6:],
            covariance=covariance,
        )

    def foretold(self, t_us: int, config: TrackConfig) -> MotionState:
        """The state at a later time: the motion goes on, and what is known of it fades."""
        after_s = (t_us - self.t_us) * 1e-6
        return MotionState(
            t_us=t_us,
            T_world_camera=self.poses(np.array(after_s)),
            velocity=self.velocity,
            covariance=faded(self.covariance, after_s, config),
        )


def faded(covariance: FloatArray, after_s: float, config: TrackConfig) -> FloatArray:
    """(12, 12) covariance of a state after a time in which nothing was seen."""
    go_on = np.eye(12) + after_s * np.eye(12, k=6)
    return np.asarray(go_on @ covariance @ go_on.T + _drift(after_s, config))


def _drift(after_s: float, config: TrackConfig) -> FloatArray:
    """(12, 12) covariance that accelerations of chance add in a time (white noise)."""
    turn, shift = np.deg2rad(config.turn_acceleration_deg_s2), config.acceleration_m_s2
    density = np.square([turn] * 3 + [shift] * 3) * ACCELERATION_S
    growth = np.array([[after_s**3 / 3.0, after_s**2 / 2.0], [after_s**2 / 2.0, after_s]])
    return np.asarray(np.kron(growth, np.diag(density)))
