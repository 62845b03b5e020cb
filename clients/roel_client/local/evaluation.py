"""A map against the truth."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from roel_client.local.maps import read_map
from roel_service.naming import naming


def evaluate_map(name: str, mesh: str, edges: str) -> dict[str, Any]:
    """The figures of `roel evaluate map`; the map is a `.rlm` file or an exported NPZ."""
    from roel_service.evaluation import maps
    from roel_service.io.clouds import read_mesh, read_points

    line_map = read_map(name)
    surface = read_mesh(Path(mesh))
    truth = read_points(Path(edges), "edges")
    with naming({"map": name, "mesh": mesh, "edges": edges}):
        return asdict(maps.evaluate_map(line_map, surface, truth))
