"""Maps against clouds of their places: starts, methods, verdicts and times, as rows of a document.

The paper's protocol turns the start about yaw, pitch and roll one after the other, 10 degrees standard
deviation each, and then shifts it by 2 cm; `wide` is any start up to 30 degrees and 0.3 m off; `heading`
and `free` move the whole map anywhere, and ask for it without a first guess; `elsewhere` asks for it in
the cloud of another place, `partial` and `half` in 70 % and half of its own cloud. `unit` is `heading` for a map whose unit
is unknown.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from roel_bench.registration_methods import METHODS, Answer, Query, Target, is_available
from roel_bench.registration_places import LARGE, MAP, ROOM, SYMMETRIC, Place, part_of
from roel_bench.results import this_machine
from roel_service.arrays import FloatArray
from roel_service.config.stages import RegisterConfig
from roel_service.errors import InputError
from roel_service.geometry.se3 import SE3, rotation_angle, rotation_from_vector
from roel_service.io.files import read_input, whole_file
from roel_service.progress import Progress, ProgressCallback
from roel_service.register.prepare import PreparedCloud, prepare_cloud, prepare_map
from roel_service.scene.clouds import PointCloud
from roel_service.scene.lines import LineMap
from roel_service.scene.results import RegistrationResult

FORMAT = "roel registration benchmark 2"
MAX_BYTES = 64 << 20

PAPER_SIGMA_RAD, PAPER_SIGMA_M = np.radians(10.0), 0.02
WIDE_TURN_RAD, WIDE_SHIFT_M = np.radians(30.0), 0.3
ANYWHERE_M = 3.0
MAX_UNIT_RATIO = 5.0

# Protocols in which no answer is right.
ELSEWHERE = ("elsewhere", "elsewhere half")

# What counts as found by a search from nothing.
FOUND_DEG, FOUND_MM = 5.0, 100.0


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One registration.

    Attributes:
        place, kind, line_count, point_count, is_tuning: what was registered; points after thinning.
        protocol, method, seed: how.
        rotation_deg, translation_mm: errors, the unit's share in the shift included; of a place with a symmetry against the nearer of its
            two right answers, and None where the truth is not known.
        verdict: as told; empty where the method tells none.
        is_listed: whether all right answers are the answer or among its alternatives.
        nees: squared error against the information, a degree of freedom; None without one.
        seconds, prepare_seconds: of the processor, for the registration and for the cloud before.
    """

    place: str
    kind: str
    line_count: int
    point_count: int
    is_tuning: bool
    protocol: str
    method: str
    seed: int
    rotation_deg: float | None
    translation_mm: float | None
    verdict: str
    is_listed: bool
    nees: float | None
    seconds: float
    prepare_seconds: float

    @property
    def key(self) -> tuple[str, str, str, int]:
        """What tells trials apart."""
        return self.place, self.protocol, self.method, self.seed


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """A way to begin: how many starts of which method, on which kinds of places.

    Attributes:
        share: of the cloud that is left, cut off across its longer side.
    """

    name: str
    method: str
    count: int
    kinds: tuple[str, ...] = (ROOM,)
    share: float = 1.0


PROTOCOLS = (
    Protocol(name="paper", method="auto", count=50),
    Protocol(name="paper", method="point", count=50),
    Protocol(name="paper", method="plane", count=5),
    Protocol(name="paper", method="open3d plane", count=5),
    Protocol(name="paper", method="open3d gicp", count=3),
    Protocol(name="paper", method="small_gicp", count=5),
    Protocol(name="wide", method="auto", count=50),
    Protocol(name="wide", method="plane", count=5),
    Protocol(name="wide", method="open3d plane", count=5),
    Protocol(name="wide", method="open3d gicp", count=3),
    Protocol(name="wide", method="small_gicp", count=5),
    Protocol(name="heading", method="global", count=20),
    Protocol(name="free", method="global", count=10),
    Protocol(name="free", method="open3d fpfh ransac", count=5),
    Protocol(name="free", method="open3d fpfh fgr", count=5),
    Protocol(name="elsewhere", method="global", count=2),
    Protocol(name="elsewhere half", method="global", count=2, share=0.5),
    Protocol(name="partial", method="auto", count=10, share=0.7),
    Protocol(name="half", method="auto", count=10, share=0.5),
    Protocol(name="unit", method="global", count=5),
    Protocol(name="wide", method="auto", count=10, kinds=(MAP,)),
    Protocol(name="heading", method="global", count=10, kinds=(MAP,)),
    Protocol(name="free", method="global", count=5, kinds=(MAP,)),
    Protocol(name="paper", method="auto", count=20, kinds=(LARGE,)),
    Protocol(name="paper", method="point", count=3, kinds=(LARGE,)),
    Protocol(name="heading", method="global", count=5, kinds=(LARGE,)),
    Protocol(name="free", method="global", count=3, kinds=(LARGE,)),
    Protocol(name="heading", method="global", count=2, kinds=(SYMMETRIC,)),
    Protocol(name="free", method="global", count=1, kinds=(SYMMETRIC,)),
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


STARTS: dict[str, Callable[[np.random.Generator], SE3]] = {
    "paper": paper_start,
    "wide": wide_start,
    "partial": wide_start,
    "half": wide_start,
}


class Clouds:
    """Targets prepared when they are first asked for, and the processor time it took."""

    def __init__(self, places: Sequence[Place], config: RegisterConfig):
        self._places = {place.name: place for place in places}
        self._config = config
        self._known: dict[tuple[str, float], tuple[Target, float]] = {}

    def of(self, name: str, share: float) -> tuple[Target, float]:
        """The target of a place, or a share of it, and the seconds."""
        if (name, share) not in self._known:
            target = self._places[name].target
            if share < 1.0 and isinstance(target, PointCloud):
                target = part_of(target, share)
            began_s = time.process_time()
            prepared = Target(cloud=self._prepared(target))
            self._known[name, share] = prepared, time.process_time() - began_s
        return self._known[name, share]

    def _prepared(self, target: PointCloud | LineMap) -> PreparedCloud:
        if isinstance(target, LineMap):
            return prepare_map(target, self._config)
        return prepare_cloud(target, self._config)

    def elsewhere(self, name: str, index: int) -> str | None:
        """The name of another room, if there are so many."""
        others = [n for n, place in sorted(self._places.items()) if place.kind == ROOM]
        if index >= len(others) - 1:
            return None
        return others[(others.index(name) + 1 + index) % len(others)]


def run(
    places: Sequence[Place],
    protocols: Sequence[Protocol],
    progress: ProgressCallback,
    *,
    path: Path | None = None,
) -> dict[str, Any]:
    """All trials of all places, as a document.

    Args:
        path: JSON file whose trials are not run again, and which keeps those that are.
    """
    document = _document(path)
    known = {Trial(**trial).key for trial in document["trials"]}
    clouds = Clouds(places, RegisterConfig())
    cells = [
        (place, protocol)
        for place in places
        for protocol in protocols
        if place.kind in protocol.kinds and is_available(protocol.method)
    ]
    for index, (place, protocol) in enumerate(cells):
        progress(
            Progress(
                stage=f"{place.name} {protocol.name} {protocol.method}",
                done_count=index,
                total_count=len(cells),
                fraction=index / len(cells),
            )
        )
        document["trials"] += [asdict(trial) for trial in _trials(place, protocol, clouds, known)]
        if path is not None:
            write_document(path, document)
    return document


def keep(trials: Sequence[Trial], path: Path) -> None:
    """Put trials into a file, in place of those of the same kind."""
    document = _document(path)
    new = {trial.key for trial in trials}
    kept = [trial for trial in document["trials"] if Trial(**trial).key not in new]
    write_document(path, document | {"trials": kept + [asdict(trial) for trial in trials]})


def _document(path: Path | None) -> dict[str, Any]:
    """This machine, and the trials of a file if there is one."""
    here = this_machine()
    return {
        "format": FORMAT,
        "machine": here.machine,
        "versions": here.versions,
        "trials": read_document(path)["trials"] if path and path.exists() else [],
    }


def _trials(
    place: Place, protocol: Protocol, clouds: Clouds, known: set[tuple[str, str, str, int]]
) -> Iterator[Trial]:
    for seed in range(protocol.count):
        if (place.name, protocol.name, protocol.method, seed) in known:
            continue
        rng = np.random.default_rng(seed)
        name: str | None = place.name
        T_moved, T_init, unit = SE3.identity(), None, 1.0
        if protocol.name in STARTS:
            T_init = STARTS[protocol.name](rng)
        else:
            T_moved = anywhere(rng, upright=protocol.name != "free")
        if protocol.name == "unit":
            unit = float(np.exp(rng.uniform(-1.0, 1.0) * np.log(MAX_UNIT_RATIO)))
        if protocol.name in ELSEWHERE:
            name = clouds.elsewhere(place.name, seed)
        if name is not None:
            prepared = clouds.of(name, protocol.share)
            yield _trial(place, protocol, seed, prepared, T_moved, T_init, unit)


def _trial(
    place: Place,
    protocol: Protocol,
    seed: int,
    prepared: tuple[Target, float],
    T_moved: SE3,
    T_init: SE3 | None,
    unit: float,
) -> Trial:
    """One registration of a map that was moved before, and told in another unit."""
    target, prepare_s = prepared
    config = dataclasses.replace(
        RegisterConfig(),
        gravity_aligned=protocol.name != "free",
        estimate_scale=protocol.name == "unit",
    )
    line_map = scaled(place.line_map.transformed(T_moved), unit)
    query = Query(line_map=line_map, target=target, T_init=T_init, config=config)
    began_s = time.process_time()
    answer = METHODS[protocol.method](query)
    seconds = time.process_time() - began_s
    motions = [SE3.identity()] + ([place.symmetry] if place.symmetry else [])
    rights = [motion @ T_moved.inverse() for motion in motions]
    nearest = min(rights, key=lambda right: errors(answer.T_target_source, right))
    degrees, millimetres = errors(answer.T_target_source, nearest)
    return Trial(
        place=place.name,
        kind=place.kind,
        line_count=len(place.line_map),
        point_count=len(target.cloud.points),
        is_tuning=place.is_tuning,
        protocol=protocol.name,
        method=protocol.method,
        seed=seed,
        rotation_deg=round(degrees, 5),
        translation_mm=round(millimetres, 4),
        verdict=answer.result.verdict.value if answer.result else "",
        is_listed=all(is_listed(answer, right) for right in rights),
        nees=_nees(answer.result, nearest) if answer.result else None,
        seconds=round(seconds, 4),
        prepare_seconds=round(prepare_s, 3),
    )


def errors(found: SE3, right: SE3) -> tuple[float, float]:
    """Rotation in degrees; shift of the source's origin, as it was before any motion, in mm."""
    off = found @ right.inverse()
    degrees = float(np.degrees(rotation_angle(off.rotation)))
    return degrees, 1e3 * float(np.linalg.norm(off.translation))


def scaled(line_map: LineMap, unit: float) -> LineMap:
    """A map with all lengths multiplied; itself with 1."""
    if unit == 1.0:
        return line_map
    return replace(line_map, segments=unit * line_map.segments, sigma_m=unit * line_map.sigma_m)


def is_found(degrees: float, millimetres: float) -> bool:
    """Whether a search from nothing came to the right place."""
    return degrees < FOUND_DEG and millimetres < FOUND_MM


def is_listed(answer: Answer, right: SE3) -> bool:
    """Whether a transform is the answer or one of its alternatives."""
    told = [answer.T_target_source]
    if answer.result is not None:
        told += [other.T_target_source for other in answer.result.alternatives]
    return any(is_found(*errors(T, right)) for T in told)


def _nees(result: RegistrationResult, right: SE3) -> float | None:
    """Squared error of (r, d) against the information, a degree of freedom."""
    if result.information is None:
        return None
    turn = Rotation.from_matrix(result.T_target_source.rotation @ right.rotation.T).as_rotvec()
    off: FloatArray = np.concatenate([turn, result.T_target_source.translation - right.translation])
    return round(float(off @ result.information @ off) / 6.0, 4)


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
