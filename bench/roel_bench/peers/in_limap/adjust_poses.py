"""LIMAP's side of `limap_poses.py`: lines, their tracks and poses in, bundle-adjusted poses out.

    python adjust_poses.py INPUT.npz OUTPUT.npz

Runs in LIMAP's own environment and therefore imports nothing of this project but its neighbours. The
arrays of the input are those of `limap_poses.write_problem`.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from limap import geometry, scene
from limap.estimators import bundle_adjustment
from lines_alone import lines_alone
from posed_images import FIRST_IMAGE_ID, posed_images


def main(input_path: Path, output_path: Path) -> None:
    """Adjust lines and all poses but the first."""
    with np.load(input_path) as file:
        problem = dict(file)
    holistic = scene.HolisticReconstruction(posed_images(problem))
    add_lines(holistic, problem)
    adjust(holistic, int(problem["iteration_count"]))
    images = holistic.point_recon.images
    poses = [images[k].cam_from_world().matrix() for k in sorted(images)]
    np.savez(output_path, T_camera_world=np.array(poses))


def add_lines(holistic: scene.HolisticReconstruction, problem: dict[str, Any]) -> None:
    """The 2D lines of every image, and the 3D lines with their observations."""
    structures = holistic.structure_recon
    for image_id, (first, last) in enumerate(pairwise(problem["line_offsets"]), FIRST_IMAGE_ID):
        lines = geometry.get_line2d_vector_from_array(
            problem["segments_px"][first:last].reshape(-1, 4)
        )
        structure = scene.Structure2d()
        structure.set_lines(lines)
        structures.add_structure2d(image_id, structure)
    observations = problem["observations"]
    for segment, (first, last) in zip(
        problem["segments"], pairwise(problem["track_offsets"]), strict=True
    ):
        line_id = structures.add_line3D(geometry.Line3d(segment))
        for frame, local in observations[first:last].tolist():
            element = pycolmap.TrackElement(FIRST_IMAGE_ID + frame, local)
            structures.add_line_observation(line_id, element)


def adjust(holistic: scene.HolisticReconstruction, iteration_count: int) -> None:
    """LIMAP's bundle adjustment with its own loss; the first pose is held."""
    config = bundle_adjustment.PointLineBundleAdjustmentConfig()
    images = holistic.point_recon.images
    for image_id in images:
        config.add_image(image_id)
    config.set_constant_rig_from_world_pose(images[FIRST_IMAGE_ID].frame_id)
    for line_id in holistic.structure_recon.lines3D:
        config.add_variable_line(line_id)
    options = lines_alone()
    options.refine_rig_from_world = True
    options.ceres.solver_options.max_num_iterations = iteration_count
    bundle_adjustment.create_point_line_bundle_adjuster(options, config, holistic).solve()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
