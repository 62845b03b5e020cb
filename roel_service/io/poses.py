"""Trajectories as TUM text: `t tx ty tz qx qy qz qw` a line, seconds, `T_world_camera`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from roel_service.arrays import BoolArray, FloatArray
from roel_service.errors import TrajectoryError
from roel_service.geometry.se3 import SE3
from roel_service.io.files import open_input, whole_file
from roel_service.io.text import MAX_TIME_US, line_of_row, parse_rows, us_from_seconds
from roel_service.scene.trajectory import Trajectory

# A quaternion this far off unit norm is rounded text; farther off, it is something else.
MAX_NORM_ERROR = 0.01

_COLUMNS = "t tx ty tz qx qy qz qw"


def read_trajectory(path: Path) -> Trajectory:
    """Read poses; quaternions are normalised, times rounded to microseconds.

    Raises:
        InputError: no readable file.
        TrajectoryError: with the number of the first line that is no pose, has a quaternion off
            unit norm or a time that does not increase; or fewer than two poses.
    """
    subject = str(path)
    with open_input(path) as file:
        text = file.read()
    rows = parse_rows(text, _COLUMNS, 1, subject, TrajectoryError)
    if len(rows) < 2:
        raise TrajectoryError(subject, "at least 2 poses", f"{len(rows)}")
    seconds, positions, quaternions = rows[:, 0], rows[:, 1:4], rows[:, 4:]

    def refuse(bad: BoolArray, expected: str, values: FloatArray) -> None:
        if bad.any():
            row = int(np.argmax(bad))
            found = f"{values[row]} in line {line_of_row(text, row, 1)}"
            raise TrajectoryError(subject, expected, found)

    refuse(np.abs(seconds) > MAX_TIME_US / 1e6, f"times within {MAX_TIME_US} us", seconds)
    with np.errstate(over="ignore"):  # infinity is off 1 as well
        norms = np.linalg.norm(quaternions, axis=1)
    refuse(np.abs(norms - 1.0) > MAX_NORM_ERROR, "quaternions of norm 1", norms)
    t_us = us_from_seconds(seconds)
    stuck = np.diff(t_us, prepend=t_us[0] - 1) <= 0
    refuse(stuck, "times that increase by a microsecond or more", seconds)
    return Trajectory(t_us=t_us, T_world_camera=SE3.from_quaternion(quaternions, positions))


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write poses; reading them again gives the same times and positions to the last bit."""
    poses = trajectory.T_world_camera
    rows = zip(
        trajectory.t_us.tolist(),
        poses.translation.tolist(),
        poses.quaternion_xyzw().tolist(),
        strict=True,
    )
    with whole_file(path) as temporary, temporary.open("w", encoding="ascii") as file:
        file.write(f"# {_COLUMNS}  (s, m; T_world_camera)\n")
        for t_us, position, quaternion in rows:
            numbers = " ".join(repr(value) for value in (*position, *quaternion))
            file.write(f"{_decimal_seconds(t_us)} {numbers}\n")


def _decimal_seconds(t_us: int) -> str:
    """Exact decimal seconds; no float in between."""
    seconds, fraction = divmod(abs(t_us), 1_000_000)
    return f"{'-' if t_us < 0 else ''}{seconds}.{fraction:06d}"
