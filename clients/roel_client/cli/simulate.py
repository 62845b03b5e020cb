"""`roel simulate`."""

from __future__ import annotations

import argparse
from pathlib import Path

from roel_client.cli.output import print_text, progress_bar
from roel_client.cli.parser import Command, Subparsers, between, command, integer, one_of
from roel_client.cli.staging import Staged


def add_commands(subparsers: Subparsers) -> None:
    """Declare `simulate`."""
    what = Command(run=simulate, inputs=("mesh",), folders=("out",))
    parser = command(subparsers, "simulate", "write a synthetic recording with its truth", what)
    parser.add_argument("--out", required=True, metavar="DIR", help="new or empty folder")
    parser.add_argument("--seed", required=True, type=integer(0), metavar="N")
    parser.add_argument("--seconds", type=between(0.01, 3600), metavar="S")
    parser.add_argument("--width", type=integer(16, 4096), metavar="PX")
    parser.add_argument("--height", type=integer(16, 4096), metavar="PX")
    parser.add_argument(
        "--fov",
        dest="fov_deg",
        type=between(1, 170),
        metavar="DEG",
        help="horizontal field of view",
    )
    parser.add_argument("--panoramas", dest="panorama_count", type=integer(0, 999), metavar="N")
    parser.add_argument(
        "--trajectory-seed",
        type=integer(0),
        metavar="N",
        help="another walk through the scene of --seed",
    )
    scene = parser.add_mutually_exclusive_group()
    scene.add_argument(
        "--scene",
        type=one_of("room", "cube", "curved"),
        metavar="NAME",
        help="room, cube or curved (a room of round things)",
    )
    scene.add_argument("--mesh", metavar="FILE", help="textured mesh of your own: glb, obj or ply")


def simulate(options: argparse.Namespace, staged: Staged) -> None:
    """Render a scene along a trajectory and write what the sensor would have sent."""
    from roel_client.local import simulation

    names = (
        "seconds",
        "width",
        "height",
        "fov_deg",
        "panorama_count",
        "trajectory_seed",
        "scene",
    )
    given = {name: value for name in names if (value := getattr(options, name)) is not None}
    if options.mesh is not None:
        given["mesh"] = Path(options.mesh)
    with progress_bar() as progress:
        event_count = simulation.simulate(staged["out"], options.seed, progress, **given)
    print_text(f"{options.out}: {event_count} events")
