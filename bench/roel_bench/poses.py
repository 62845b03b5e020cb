"""Pose refinement: the paper's cube with its ablation, and rooms, as rows of a document.

The file keeps the rows of an interrupted run; what it holds is not run again.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from roel_bench.catalogue import Places, open_scene
from roel_bench.poses_cube import ALONE, CubeRow, cube_rows
from roel_bench.poses_rooms import PoseErrors, RoomRow, room_row
from roel_bench.results import this_machine
from roel_bench.scenes import Scene
from roel_service.errors import InputError
from roel_service.io.files import read_input, whole_file
from roel_service.progress import Progress, ProgressCallback
from roel_service.simulate.dataset import SimulationConfig, simulate_dataset

FORMAT = "roel poses benchmark 1"
MAX_BYTES = 16 << 20

# The cube fills the picture from where the paper looks at it.
CUBE = SimulationConfig(seconds=1.2, fov_deg=40.0, panorama_count=0, scene="cube")
CUBE_NAME, CUBE_SEED = "cube_1_346x260_1.2s", 1
SEED_COUNT = 5


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseResults:
    """All rows, and what they were measured on."""

    machine: dict[str, Any]
    versions: dict[str, str]
    cube: list[CubeRow] = field(default_factory=list)
    rooms: list[RoomRow] = field(default_factory=list)


def run(
    path: Path, rooms: Sequence[str], seed_count: int, places: Places, progress: ProgressCallback
) -> PoseResults:
    """Run what the file does not hold yet, and write each row as it comes.

    Args:
        path: JSON, made if need be.
        rooms: names of scenes with noisy poses and true surfaces.
        seed_count: draws of noise for the cube; 0 leaves it out.
        places: where scenes are found; the cube is simulated once and kept there.
        progress: called with each row.
    """
    machine = this_machine()
    empty = PoseResults(machine=machine.machine, versions=machine.versions)
    results = read_results(path) if path.exists() else empty
    wanted_rooms = [name for name in rooms if name not in {row.room for row in results.rooms}]
    done_seeds = {row.seed for row in results.cube if row.method == ALONE}
    seeds = [seed for seed in range(seed_count) if seed not in done_seeds]
    total = len(wanted_rooms) + len(seeds)
    done = 0

    def tell(stage: str) -> None:
        progress(
            Progress(stage=stage, done_count=done, total_count=total, fraction=done / max(1, total))
        )

    if seeds:
        scene = cube_scene(places, progress)
        for row in cube_rows(scene, seeds):
            kept = [old for old in results.cube if (old.method, old.seed) != (row.method, row.seed)]
            results = replace(results, cube=[*kept, row])
            write_results(path, results)
            done += row.method == ALONE
            tell("cube")
    for name in wanted_rooms:
        tell(name)
        found = room_row(open_scene(name, places, progress))
        results = replace(results, rooms=[*results.rooms, found])
        write_results(path, results)
        done += 1
    return results


def cube_scene(places: Places, progress: ProgressCallback) -> Scene:
    """The paper's cube, simulated once."""
    folder = places.rooms / CUBE_NAME
    if not folder.exists():
        places.rooms.mkdir(parents=True, exist_ok=True)
        simulate_dataset(folder, CUBE, CUBE_SEED, progress)
    return open_scene(f"folder:{folder}", places, progress)


def write_results(path: Path, results: PoseResults) -> None:
    """One row a line; the file is whole or as it was before."""
    parts = [
        f'"machine": {json.dumps(results.machine)}',
        f'"versions": {json.dumps(results.versions)}',
    ]
    for name, rows in (("cube", results.cube), ("rooms", results.rooms)):
        lines = ",\n".join(json.dumps(asdict(row)) for row in rows)
        parts.append(f'"{name}": [\n{lines}\n]')
    with whole_file(path) as temporary:
        text = f'{{"format": {json.dumps(FORMAT)},\n' + ",\n".join(parts) + "}\n"
        temporary.write_text(text, encoding="utf-8")


def read_results(path: Path) -> PoseResults:
    """Read what `write_results` wrote.

    Raises:
        InputError: no readable file, or no rows of this format.
    """
    try:
        document: dict[str, Any] = json.loads(read_input(path, MAX_BYTES))
        if document["format"] != FORMAT:
            raise InputError(str(path), FORMAT, repr(document["format"]))
        return PoseResults(
            machine=document["machine"],
            versions=document["versions"],
            cube=[CubeRow(**row) for row in document["cube"]],
            rooms=[_room(row) for row in document["rooms"]],
        )
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(str(path), f"JSON of format {FORMAT!r}", str(error)) from error


def _room(row: dict[str, Any]) -> RoomRow:
    errors = {name: PoseErrors(**row[name]) for name in ("given", "smooth", "refined", "exact")}
    return RoomRow(**(row | errors | {"problems": tuple(row["problems"])}))
