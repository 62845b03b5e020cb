"""`roel track`."""

from __future__ import annotations

import argparse
from collections import Counter

from roel_client.cli.configuration import (
    add_config_options,
    add_seed_option,
    effective_config,
    seed_table,
)
from roel_client.cli.output import print_result, print_text
from roel_client.cli.parser import Command, Subparsers, command, size
from roel_client.cli.staging import Staged
from roel_service.errors import NoAnswerError

TRACKING = "TRACKING"
# What a trajectory needs.
MIN_POSE_COUNT = 2


def add_commands(subparsers: Subparsers) -> None:
    """Declare `track`."""
    what = Command(
        run=track, inputs=("map", "events", "camera", "init", "config"), outputs=("out",)
    )
    parser = command(subparsers, "track", "follow an event camera in a map", what)
    parser.add_argument("map", metavar="MAP", help=".rlm file or exported .npz")
    parser.add_argument(
        "--events", required=True, metavar="FILE", help="HDF5, NPZ, or text `t_seconds x y p`"
    )
    parser.add_argument(
        "--camera", required=True, metavar="FILE", help="calibration as JSON, YAML or one line"
    )
    parser.add_argument(
        "--sensor-size", type=size, metavar="WxH", help="for a calibration that does not say it"
    )
    parser.add_argument(
        "--init",
        required=True,
        metavar="T.txt",
        help="T_world_camera of the first events, within 20 cm and 10 degrees",
    )
    parser.add_argument(
        "--out", metavar="POSES.txt", help="TUM text of the poses that may be relied on"
    )
    add_config_options(parser)
    add_seed_option(parser)
    parser.add_argument("--json", action="store_true", help="print as JSON, one line a pose")


def track(options: argparse.Namespace, staged: Staged) -> None:
    """Follow the camera of a recording, and print each pose as soon as it is known."""
    from roel_client.local import tracking

    config = effective_config(options, seed_table(options))
    poses = tracking.TrackedRecording(
        options.map, options.events, options.camera, options.sensor_size, options.init, config
    )
    counts: Counter[str] = Counter()
    for document in poses.documents():
        counts[document["status"]] += 1
        if options.json:
            print_result(document, "", as_json=True)
    if counts[TRACKING] < MIN_POSE_COUNT:
        expected = f"at least {MIN_POSE_COUNT} poses to rely on"
        found = f"{counts[TRACKING]} of {counts.total()}"
        raise NoAnswerError(options.events, expected, found, reason="NOT_TRACKED")
    if options.out is not None:
        poses.write(staged["out"])
    if not options.json:
        shares = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
        print_text(f"{options.events}: {counts.total()} poses: {shares}")
