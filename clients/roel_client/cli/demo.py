"""`roel demo`: simulate, build, compare with the truth, register, localize, show."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from roel_client.cli import evaluate
from roel_client.cli.output import print_result, progress_bar, to_json
from roel_client.cli.parser import Command, Subparsers, command
from roel_client.cli.staging import Staged
from roel_service.config.load import load_config

SEED = 7
SECONDS = 2.5
PANORAMA_COUNT = 3


def add_commands(subparsers: Subparsers) -> None:
    """Declare `demo`."""
    what = Command(run=demo, folders=("out",), scratch=True)
    parser = command(
        subparsers, "demo", "simulate a room, map it and compare the map with the truth", what
    )
    parser.add_argument("--out", metavar="DIR", help="new or empty folder to keep everything in")
    parser.add_argument("--json", action="store_true", help="print as JSON")


def demo(options: argparse.Namespace, staged: Staged) -> None:
    """Run the whole chain on a simulated room."""
    from roel_client.local import (
        building,
        evaluation,
        localization,
        recordings,
        registration,
        simulation,
    )

    folder = staged.get("out", staged["scratch"])
    room = folder / "room"
    folder.mkdir(exist_ok=True)
    with progress_bar() as progress:
        simulation.simulate(room, SEED, progress, seconds=SECONDS, panorama_count=PANORAMA_COUNT)
    recording = recordings.open_recording(
        str(room / "events.h5"), str(room / "poses.txt"), str(room / "camera.json"), None
    )
    with progress_bar() as progress:
        built = building.build_map(recording, load_config("default"), progress)
    (folder / "map.rlm").write_bytes(built.rlm_bytes)
    (folder / "report.json").write_text(to_json(built.report) + "\n", encoding="utf-8")
    building.draw_map(built, recording, folder / "map.png")
    truth = str(room / "gt.npz")
    figures = evaluation.evaluate_map(str(folder / "map.rlm"), truth, truth)
    registered = registration.register_map(
        str(folder / "map.rlm"),
        str(room / "cloud.npz"),
        init=None,
        method="global",
        config=load_config("default").register,
        plot=folder / "registration.png",
    )
    localized = list(
        localization.localize_panoramas(
            [str(folder / "map.rlm")],
            [str(room / "panos" / f"{index:03d}.jpg") for index in range(PANORAMA_COUNT)],
            method="default",
            prior=None,
            config=load_config("default").localize,
            overlay=folder / "localization",
        )
    )
    places = _places(room / "panos" / "poses.txt")
    picture = None if options.out is None else str(Path(options.out, "map.png"))
    document = {
        "report": built.report,
        "evaluation": figures,
        "registration": registered,
        "localization": [
            document | {"true_position": place}
            for document, place in zip(localized, places, strict=True)
        ],
        "picture": picture,
    }
    print_result(document, _told(document), as_json=options.json)


def _told(document: dict[str, Any]) -> str:
    report, picture = document["report"], document["picture"]
    return "\n".join(
        [
            f"built {report['line_count']} lines from {report['event_count']} events of a "
            f"simulated room in {report['seconds_total']:.1f} s",
            evaluate.told(document["evaluation"]),
            _told_registration(document["registration"]),
            _told_localization(document["localization"]),
            f"picture: {picture}" if picture else "nothing is kept; --out DIR keeps it all",
        ]
    )


def _places(poses: Path) -> list[list[float]]:
    """Where the room's panoramas were taken, m."""
    lines = poses.read_text(encoding="utf-8").splitlines()
    return [[float(word) for word in line.split()[1:4]] for line in lines if line[0] != "#"]


def _told_localization(documents: list[dict[str, Any]]) -> str:
    """How many panoramas were located, and how far from the truth."""
    located = [document for document in documents if document["T_world_panorama"] is not None]
    shifts_mm = [
        1e3 * math.dist([row[3] for row in document["T_world_panorama"]][:3], place)
        for document, place in ((document, document["true_position"]) for document in located)
    ]
    off = f", {max(shifts_mm):.1f} mm off at the most" if shifts_mm else ""
    return (
        f"located {len(located)} of {len(documents)} panoramas{off}; "
        "the recording shows a part of the room, and they were taken anywhere in it"
    )


def _told_registration(found: dict[str, Any]) -> str:
    """How far from the truth the map was found in the room's cloud: both lie in the same frame."""
    T = found["T_target_source"]
    cosine = (T[0][0] + T[1][1] + T[2][2] - 1.0) / 2.0
    turn_deg = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
    shift_mm = 1e3 * math.hypot(*(row[3] for row in T[:3]))
    return (
        f"found in the room's point cloud without a first guess: {turn_deg:.2f} degrees and "
        f"{shift_mm:.1f} mm off, {found['verdict']}"
    )
