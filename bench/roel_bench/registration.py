"""Maps against clouds of their places: starts, methods, verdicts and times, as rows of a document.

The paper's protocol turns the start about yaw, pitch and roll one after the other, 10 degrees standard
deviation each, and then shifts it by 2 cm; `wide` is any start up to 30 degrees and 0.3 m off; `heading`
and `free` move the whole map anywhere, and ask for it without a first guess; `elsewhere` asks for it in
the cloud of another place.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from roel_bench.catalogue import TUNING_SEEDS
from roel_bench.results import this_machine
from roel_service.config.stages import RegisterConfig
from roel_service.errors import InputError
from roel_service.geometry.se3 import SE3, rotation_angle, rotation_from_vector
from roel_service.io.files import read_input, whole_file
from roel_service.progress import Progress, ProgressCallback
from roel_service.register.prepare import PreparedCloud, prepare_cloud
from roel_service.register.register import register_map
from roel_service.scene.clouds import PointCloud
from roel_service.scene.lines import LineMap
from roel_service.scene.results import RegistrationResult

FORMAT = "roel registration benchmark 1"
MAX_BYTES = 64 << 20

PAPER_SIGMA_RAD, PAPER_SIGMA_M = np.radians(10.0), 0.02
WIDE_TURN_RAD, WIDE_SHIFT_M = np.radians(30.0), 0.3
ANYWHERE_M = 3.0

# Parameters were chosen by looking at these.
TUNING_PLACES = ("room_11", "room_12", *(f"sim_{seed}" for seed in TUNING_SEEDS))


@dataclass(frozen=True, eq=False, kw_only=True)
class Place:
    """A map and the cloud of the same place, in one frame: the true transform is the identity."""

    name: str
    line_map: LineMap
    cloud: PointCloud
    is_tuning: bool


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One registration.

    Attributes:
        place, line_count, point_count, is_tuning: what was registered; points after thinning.
        protocol, method, seed: how.
        rotation_deg, translation_mm: errors.
        verdict: as told.
        seconds, prepare_seconds: of the registration, and of the cloud before.
    """

    place: str
    line_count: int
    point_count: int
    is_tuning: bool
    protocol: str
    method: str
    seed: int
    rotation_deg: float
    translation_mm: float
    verdict: str
    seconds: float
    prepare_seconds: float


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """A way to begin: how many starts of which method, and what each start is."""

    name: str
    method: str
    count: int


PROTOCOLS = (
    Protocol(name="paper", method="auto", count=50),
    Protocol(name="paper", method="point", count=10),
    Protocol(name="wide", method="auto", count=50),
    Protocol(name="heading", method="global", count=20),
    Protocol(name="free", method="global", count=10),
    Protocol(name="elsewhere", method="global", count=2),
)


def paper_start(rng: np.random.Generator) -> SE3:
    """The published perturbation."""
    rotation = np.eye(3)
    for axis in (2, 1, 0):  # yaw, pitch, roll
        rotation = (
            rotation_from_vector(rng.normal(0.0, PAPER_SIGMA_RAD) * np.eye(3)[axis]) @ rotation
        )
    return SE3(rotation=rotation, translation=rng.normal(0.0, PAPER_SIGMA_M, 3))


def wide_start(rng: np.random.Generator) -> SE3:
    """Up to 30 degrees about any axis, and up to 0.3 m."""
    axis, direction = rng.normal(size=(2, 3))
    turn = rng.uniform(0.0, WIDE_TURN_RAD) * axis / np.linalg.norm(axis)
    shift = rng.uniform(0.0, WIDE_SHIFT_M) * direction / np.linalg.norm(direction)
    return SE3(rotation=rotation_from_vector(turn), translation=shift)


def anywhere(rng: np.random.Generator, *, upright: bool) -> SE3:
    """Any heading, or any rotation, and a shift of some metres."""
    rotation = Rotation.random(random_state=rng).as_matrix()
    if upright:
        rotation = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    return SE3(rotation=rotation, translation=rng.uniform(-ANYWHERE_M, ANYWHERE_M, 3))


def run(
    places: Sequence[Place], protocols: Sequence[Protocol], progress: ProgressCallback
) -> dict[str, Any]:
    """All trials of all places, as a document."""
    config = RegisterConfig()
    trials: list[Trial] = []
    prepared: dict[str, tuple[PreparedCloud, float]] = {}
    for place in places:
        began_s = time.perf_counter()
        cloud = prepare_cloud(place.cloud, config)
        prepared[place.name] = cloud, time.perf_counter() - began_s
    total = len(places) * sum(protocol.count for protocol in protocols)
    for place in places:
        for protocol in protocols:
            for trial in _trials(place, protocol, prepared, config):
                trials.append(trial)
                progress(
                    Progress(
                        stage=f"{place.name} {protocol.name}",
                        done_count=len(trials),
                        total_count=total,
                        fraction=len(trials) / total,
                    )
                )
    here = this_machine()
    return {
        "format": FORMAT,
        "machine": here.machine,
        "versions": here.versions,
        "trials": [asdict(trial) for trial in trials],
    }


def _trials(
    place: Place,
    protocol: Protocol,
    prepared: dict[str, tuple[PreparedCloud, float]],
    config: RegisterConfig,
) -> Iterator[Trial]:
    others = [name for name in prepared if name != place.name]
    for seed in range(protocol.count):
        rng = np.random.default_rng(seed)
        name, T_true, T_init = place.name, SE3.identity(), None
        if protocol.name in STARTS:
            T_init = STARTS[protocol.name](rng)
        else:
            T_true = anywhere(rng, upright=protocol.name != "free")
        if protocol.name == "elsewhere":
            if seed >= len(others):
                return
            at = sorted(prepared).index(place.name) + 1 + seed
            name = sorted(prepared)[at % len(prepared)]
        cloud, prepare_s = prepared[name]
        line_map = place.line_map.transformed(T_true)
        asked = dataclasses.replace(config, gravity_aligned=protocol.name != "free")
        began_s = time.perf_counter()
        result = register_map(line_map, cloud, asked, method=protocol.method, T_init=T_init)
        seconds = time.perf_counter() - began_s
        degrees, millimetres = errors(result, T_true)
        yield Trial(
            place=place.name,
            line_count=len(line_map),
            point_count=len(cloud.points),
            is_tuning=place.is_tuning,
            protocol=protocol.name,
            method=protocol.method,
            seed=seed,
            rotation_deg=round(degrees, 5),
            translation_mm=round(millimetres, 4),
            verdict=result.verdict.value,
            seconds=round(seconds, 4),
            prepare_seconds=round(prepare_s, 3),
        )


STARTS: dict[str, Callable[[np.random.Generator], SE3]] = {
    "paper": paper_start,
    "wide": wide_start,
}


def errors(result: RegistrationResult, T_moved: SE3) -> tuple[float, float]:
    """Rotation in degrees; shift of the frame's origin in mm, with any known motion undone."""
    off = result.T_target_source @ T_moved
    degrees = float(np.degrees(rotation_angle(off.rotation)))
    return degrees, 1e3 * float(np.linalg.norm(off.translation))


def write_document(path: Path, document: dict[str, Any]) -> None:
    """One trial a line; the file is whole or as it was before."""
    head = {key: value for key, value in document.items() if key != "trials"}
    trials = ",\n".join(json.dumps(trial) for trial in document["trials"])
    with whole_file(path) as temporary:
        text = json.dumps(head).removesuffix("}") + f', "trials": [\n{trials}\n]}}\n'
        temporary.write_text(text, encoding="utf-8")


def read_document(path: Path) -> dict[str, Any]:
    """Read what `write_document` wrote.

    Raises:
        InputError: no readable file, or no trials of this format.
    """
    try:
        document: dict[str, Any] = json.loads(read_input(path, MAX_BYTES))
        if document["format"] != FORMAT:
            raise InputError(str(path), FORMAT, repr(document["format"]))
        trials = [asdict(Trial(**trial)) for trial in document["trials"]]
        return document | {"trials": trials}
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(str(path), f"JSON of format {FORMAT!r}", str(error)) from error
