"""A picture of refined poses: the given and the refined trajectory, and the truth where it is known."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.geometry.alignment import align_poses
from roel_service.geometry.se3 import rotation_angle
from roel_service.scene.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GIVEN_COLOR, REFINED_COLOR, TRUE_COLOR = "#9aa0a6", "#d6336c", "#202124"
# Views: title and the two world axes that span it.
VIEWS = (("x and y", (0, 1)), ("x and z", (0, 2)))


def draw_trajectories(
    given: Trajectory, refined: Trajectory, truth: Trajectory | None, path: Path
) -> None:
    """Write a PNG of two trajectories at the same times.

    With a truth both are aligned to it (rotation and translation), and their errors are drawn;
    without one, how far the refined poses are from the given ones.

    Args:
        given, refined: at the same times.
        truth: true poses; poses that it does not cover are left out.
    """
    from matplotlib.figure import Figure

    given, refined = _aligned(given, truth), _aligned(refined, truth)
    figure = Figure(figsize=(11, 9), dpi=110, layout="constrained")
    above, below = figure.subplots(2, 2)
    for axes, (view, plan) in zip(above, VIEWS, strict=True):
        _draw_paths(axes, plan, given, refined, truth)
        axes.set_title(view)
    above[0].legend()
    _draw_differences(below, given, refined, truth)
    figure.savefig(path, format="png")


def _aligned(trajectory: Trajectory, truth: Trajectory | None) -> Trajectory:
    """In the world of the truth, where that covers it."""
    if truth is None:
        return trajectory
    covered = truth.covers(trajectory.t_us)
    t_us, poses = trajectory.t_us[covered], trajectory.T_world_camera[covered]
    moved = align_poses(poses, truth.interpolate(t_us)) @ poses
    return Trajectory(t_us=t_us, T_world_camera=moved)


def _draw_paths(
    axes: Axes,
    plan: tuple[int, int],
    given: Trajectory,
    refined: Trajectory,
    truth: Trajectory | None,
) -> None:
    drawn = [("given", given, GIVEN_COLOR, 1.0), ("refined", refined, REFINED_COLOR, 1.0)]
    if truth is not None:
        drawn.append(("true", truth, TRUE_COLOR, 0.6))
    for name, trajectory, color, width in drawn:
        points = trajectory.T_world_camera.translation[:, list(plan)]
        axes.plot(*points.T, color=color, linewidth=width, label=name)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"{'xyz'[plan[0]]} in m")
    axes.set_ylabel(f"{'xyz'[plan[1]]} in m")


def _draw_differences(
    row: tuple[Axes, Axes], given: Trajectory, refined: Trajectory, truth: Trajectory | None
) -> None:
    """Distances and angles over time: errors, or what refinement changed."""
    if truth is None:
        pairs = [("refined against given", refined, given, REFINED_COLOR)]
    else:
        true = Trajectory(t_us=given.t_us, T_world_camera=truth.interpolate(given.t_us))
        pairs = [("given", given, true, GIVEN_COLOR), ("refined", refined, true, REFINED_COLOR)]
    positions, orientations = row
    for name, trajectory, other, color in pairs:
        t_s = trajectory.t_us * 1e-6
        distances_mm, angles_deg = _differences(trajectory, other)
        positions.plot(t_s, distances_mm, color=color, linewidth=0.8, label=name)
        orientations.plot(t_s, angles_deg, color=color, linewidth=0.8, label=name)
    what = "difference" if truth is None else "error"
    positions.set_ylabel(f"{what} of position in mm")
    orientations.set_ylabel(f"{what} of orientation in degrees")
    for axes in row:
        axes.set_xlabel("time in s")
        axes.legend()


def _differences(trajectory: Trajectory, other: Trajectory) -> tuple[FloatArray, FloatArray]:
    """(N,) mm and (N,) degrees between two trajectories at the same times."""
    a, b = trajectory.T_world_camera, other.T_world_camera
    distances_mm = 1e3 * np.linalg.norm(a.translation - b.translation, axis=-1)
    angles_rad = rotation_angle(np.swapaxes(a.rotation, -1, -2) @ b.rotation)
    return np.asarray(distances_mm), np.degrees(angles_rad)
