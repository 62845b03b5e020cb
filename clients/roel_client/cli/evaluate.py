"""`roel evaluate map`."""

from __future__ import annotations

import argparse
from typing import Any

from roel_client.cli.output import print_result
from roel_client.cli.parser import Command, Subparsers, command, command_group
from roel_client.cli.staging import Staged


def add_commands(subparsers: Subparsers) -> None:
    """Declare `evaluate map`."""
    group = command_group(subparsers, "evaluate", "compare with the truth")
    evaluate = Command(run=evaluate_map, inputs=("map", "mesh", "edges"))
    parser = command(group, "map", "compare a map with true surfaces and edges", evaluate)
    parser.add_argument("map", metavar="MAP", help=".rlm file or exported .npz")
    parser.add_argument(
        "--mesh", required=True, metavar="FILE", help="NPZ with `triangles`, or PLY with faces"
    )
    parser.add_argument(
        "--edges", required=True, metavar="FILE", help="NPZ with `edges`, or PLY points"
    )
    parser.add_argument("--json", action="store_true", help="print as JSON")


def evaluate_map(options: argparse.Namespace, staged: Staged) -> None:
    """Print how far a map is from the truth."""
    from roel_client.local import evaluation

    figures = evaluation.evaluate_map(options.map, options.mesh, options.edges)
    print_result(figures, told(figures), as_json=options.json)


def told(figures: dict[str, Any]) -> str:
    """The figures for people."""
    return (
        f"{figures['line_count']} lines: accuracy {figures['accuracy_mm']:.1f} mm, "
        f"completion {figures['completion_mm']:.1f} mm\n"
        f"IoU {figures['iou_5']:.3f} at 5 mm, {figures['iou_10']:.3f} at 10 mm, "
        f"{figures['iou_20']:.3f} at 20 mm; at 20 mm precision {figures['precision_20']:.2f}, "
        f"recall {figures['recall_20']:.2f}"
    )
