"""LIMAP's side of `limap.py`: 2D lines and their matches in, 3D segments out.

    python map_lines.py INPUT.npz OUTPUT.npz

Runs in LIMAP's own environment and therefore imports nothing of this project but its neighbours. The
arrays of the input are those of `limap.write_problem`; the output holds `segments` (L, 2, 3), world, m, and
`observation_count` (L,).
"""

from __future__ import annotations

import json
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from limap import geometry, scene, sfm
from limap.estimators import bundle_adjustment
from lines_alone import lines_alone
from posed_images import posed_images

# LIMAP 1 refines with this many steps, LIMAP 2 with half of it.
MAX_ITERATION_COUNT = 200


def main(input_path: Path, output_path: Path) -> None:
    """Triangulate, refine, write."""
    with np.load(input_path) as file:
        problem = dict(file)
    options = json.loads(str(problem.pop("options")))
    reconstruction = posed_images(problem)
    holistic = triangulated(reconstruction, problem, options, input_path.parent)
    refine(holistic, options)
    lines = [line for _, line in sorted(holistic.structure_recon.lines3D.items())]
    segments = [line.as_array() for line in lines]
    np.savez(
        output_path,
        segments=np.array(segments).reshape(-1, 2, 3),
        observation_count=np.array([line.track.length() for line in lines], np.int64),
    )


def triangulated(
    reconstruction: pycolmap.Reconstruction,
    problem: dict[str, Any],
    options: dict[str, Any],
    folder: Path,
) -> scene.HolisticReconstruction:
    """Lines of LIMAP's global triangulation."""
    database_path = folder / "structures.db"
    scene.create_structure_db(database_path)
    with scene.StructureDatabase.open(database_path) as database:
        scene.initialize_structures_from_reconstruction(database, reconstruction)
        scene.import_line_detections(database, lines_of_images(problem))
        for pair, matches in zip(problem["pairs"], rows(problem, "match"), strict=True):
            image_1, image_2 = (pair + 1).tolist()
            database.write_line_matches(image_1, image_2, matches.astype(np.uint32))
    return sfm.pipelines.global_line_triangulation(
        reconstruction, database_path, triangulation_options(options), exhaustive_neighbors(problem)
    )


def lines_of_images(problem: dict[str, Any]) -> dict[int, Any]:
    """LIMAP's lines by image."""
    return {
        image_id: geometry.get_line2d_vector_from_array(segments.reshape(-1, 4))
        for image_id, segments in enumerate(rows(problem, "line"), start=1)
    }


def exhaustive_neighbors(problem: dict[str, Any]) -> dict[int, list[int]] | None:
    """Neighbours whose lines are all tried; none where matches are given."""
    if len(problem["neighbors"]) == 0:
        return None
    return {
        image_id: (neighbors + 1).tolist()
        for image_id, neighbors in enumerate(rows(problem, "neighbor"), start=1)
    }


def rows(problem: dict[str, Any], name: str) -> list[Any]:
    """The parts of a ragged array."""
    values = {"line": "segments_px", "match": "matches", "neighbor": "neighbors"}[name]
    return [problem[values][first:last] for first, last in pairwise(problem[f"{name}_offsets"])]


def triangulation_options(options: dict[str, Any]) -> sfm.GlobalLineTriangulationOptions:
    """LIMAP's defaults, except for what the problem says; no points or vanishing points known."""
    chosen = sfm.GlobalLineTriangulationOptions()
    chosen.use_point_assisted_triangulation = False
    chosen.use_vp_assisted_triangulation = False
    for name, value in options["triangulation"].items():
        setattr(chosen, name, value)
    for name, value in options["linker3d"].items():
        setattr(chosen.linker3d_options, name, value)
    chosen.num_threads = options["thread_count"]
    return chosen


def refine(holistic: scene.HolisticReconstruction, options: dict[str, Any]) -> None:
    """Bundle adjustment of the lines alone: cameras stay, and every line must be added by hand."""
    config = bundle_adjustment.PointLineBundleAdjustmentConfig()
    for image_id in holistic.point_recon.images:
        config.add_image(image_id)
    for line_id in holistic.structure_recon.lines3D:
        config.add_variable_line(line_id)
    chosen = lines_alone()
    chosen.loss_function_scale_line = options["loss_scale_px"]
    chosen.line_weight_normalization_length = options["loss_length_px"]
    chosen.ceres.solver_options.max_num_iterations = MAX_ITERATION_COUNT
    chosen.ceres.solver_options.num_threads = options["thread_count"]
    adjuster = bundle_adjustment.create_point_line_bundle_adjuster(chosen, config, holistic)
    adjuster.solve()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
