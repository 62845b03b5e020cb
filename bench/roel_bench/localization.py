"""Panoramas located in maps of their places: protocols, methods and trials, as a document.

`here` asks for each panorama in the map of its place; `moved` after any rigid motion of the map,
`yaw_5` and `yaw_17` after one about the vertical; `elsewhere` asks the map of another room; `prior`
gives a first guess; `width_*` and `quality_*` change the picture.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from roel_bench import memory
from roel_bench.localization_methods import METHODS, Answer, Method
from roel_bench.localization_places import HOUSE, HOUSE_ROOM, ROOM, Panorama, Place
from roel_bench.registration import anywhere
from roel_bench.results import this_machine
from roel_service.arrays import Array
from roel_service.errors import InputError
from roel_service.evaluation.poses import rotation_errors_rad, translation_errors_m
from roel_service.geometry.se3 import SE3, rotation_angle, rotation_from_vector
from roel_service.geometry.vectors import unit
from roel_service.io.files import read_input, whole_file
from roel_service.pano_loc.directions import principal_frame, shared_directions
from roel_service.progress import Progress, ProgressCallback
from roel_service.scene.lines import LineMap

FORMAT = "roel localization benchmark 1"
MAX_BYTES = 16 << 20

# A pose is right within these.
FINE_M, FINE_DEG = 0.1, 5.0
COARSE_M, COARSE_DEG = 0.3, 15.0
PRIOR_TURN_RAD, PRIOR_SHIFT_M = np.radians(25.0), 0.4
MOTION_COUNT = 4
FEW, SOME, MANY = 3, 8, 10

HERE, MOVED, ELSEWHERE, PRIOR = "here", "moved", "elsewhere", "prior"
WIDTHS_PX = (512, 1024, 4096)
QUALITIES = (10, 30, 50, 70)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One panorama, located.

    Attributes:
        panorama: its place and name.
        status: as told; empty where a method tells none.
        rotation_deg, translation_m: errors of the best pose; None without a pose.
        is_listed: whether any of the poses is right.
        score, margin: as told, or None.
        nees: squared error against the covariance, a degree of freedom; None without one.
        seconds: of the processor, from the decoded picture to the answer.
        clock_seconds: the same by the clock, which other work on the machine lengthens.
    """

    panorama: str
    status: str
    rotation_deg: float | None
    translation_m: float | None
    is_listed: bool
    score: float | None
    margin: float | None
    nees: float | None
    seconds: float
    clock_seconds: float


@dataclass(frozen=True, kw_only=True)
class Cell:
    """All trials of a place, protocol and method.

    Attributes:
        kind, is_tuning, line_count: of the place.
        off_axes_deg: angle between the directions of the map's lines and the world's axes.
        prepare_seconds: of the processor, to prepare the map once.
        peak_rss_mib: of the whole process, or None where the system does not tell.
    """

    place: str
    kind: str
    is_tuning: bool
    line_count: int
    off_axes_deg: float
    protocol: str
    method: str
    prepare_seconds: float
    peak_rss_mib: float | None
    trials: tuple[Trial, ...]

    @property
    def key(self) -> tuple[str, str, str]:
        """What tells cells apart."""
        return self.place, self.protocol, self.method


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """A way to ask.

    Attributes:
        kinds: of the places that are asked for; empty for all.
        methods: that take part; empty for all.
        max_count: panoramas of a place at the most.
        motions: how the place is moved before; panoramas take turns.
        change: of the picture.
        has_prior: whether a first guess is given.
    """

    name: str
    kinds: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    max_count: int = 1000
    motions: tuple[SE3, ...] = (SE3.identity(),)
    change: Callable[[Array], Array] | None = None
    has_prior: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class Question:
    """What a cell answers: panoramas, asked of a place in a way by a method."""

    place: Place
    protocol: Protocol
    method: Method
    asked: tuple[Panorama, ...]

    @property
    def key(self) -> tuple[str, str, str]:
        """That of the cell."""
        return self.place.name, self.protocol.name, self.method.name


def _yaw(degrees: float) -> tuple[SE3, ...]:
    turn = rotation_from_vector(np.array([0.0, 0.0, np.radians(degrees)]))
    return (SE3(rotation=turn, translation=np.zeros(3)),)


def resized(width: int) -> Callable[[Array], Array]:
    """Changes a picture's size."""

    def change(grey: Array) -> Array:
        kind = cv2.INTER_AREA if width < grey.shape[1] else cv2.INTER_CUBIC
        return np.asarray(cv2.resize(grey, (width, width // 2), interpolation=kind))

    return change


def compressed(quality: int) -> Callable[[Array], Array]:
    """Changes a picture as JPEG of a quality does."""

    def change(grey: Array) -> Array:
        data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))

    return change


PROTOCOLS = (
    Protocol(name=HERE),
    Protocol(
        name=MOVED,
        kinds=(ROOM, HOUSE, HOUSE_ROOM),
        max_count=MANY,
        motions=tuple(
            anywhere(np.random.default_rng(seed), upright=False) for seed in range(MOTION_COUNT)
        ),
    ),
    Protocol(
        name="yaw_5",
        kinds=(ROOM,),
        methods=("fgpl", "fgpl-released"),
        max_count=FEW,
        motions=_yaw(5.0),
    ),
    Protocol(
        name="yaw_17",
        kinds=(ROOM,),
        methods=("fgpl", "fgpl-released"),
        max_count=FEW,
        motions=_yaw(17.0),
    ),
    Protocol(name=ELSEWHERE, kinds=(ROOM,), methods=("default",), max_count=SOME),
    Protocol(name=PRIOR, kinds=(ROOM,), methods=("default",), max_count=SOME, has_prior=True),
    *(
        Protocol(
            name=f"width_{width}",
            kinds=(ROOM,),
            methods=("default",),
            max_count=SOME,
            change=resized(width),
        )
        for width in WIDTHS_PX
    ),
    *(
        Protocol(
            name=f"quality_{quality}",
            kinds=(ROOM,),
            methods=("default",),
            max_count=SOME,
            change=compressed(quality),
        )
        for quality in QUALITIES
    ),
)


@dataclass(frozen=True, kw_only=True)
class Results:
    """Cells of a benchmark, in the order in which they were run."""

    machine: dict[str, str | int]
    versions: dict[str, str]
    cells: tuple[Cell, ...] = ()

    def with_cell(self, cell: Cell) -> Results:
        """These cells and one more, which takes the place of an older one of its key."""
        others = tuple(other for other in self.cells if other.key != cell.key)
        return Results(machine=self.machine, versions=self.versions, cells=(*others, cell))


def run(
    places: Sequence[Place],
    protocols: Sequence[Protocol],
    methods: Sequence[Method],
    path: Path,
    progress: ProgressCallback,
    *,
    again: bool = False,
) -> Results:
    """Run the cells that the file does not hold, or of fewer panoramas; write each once it is known.

    Args:
        path: JSON file of an interrupted run, or a new one.
        again: run the cells that it does hold, too.

    Raises:
        InputError: a file of something else.
    """
    here = this_machine()
    results = read_results(path) if path.exists() else Results(machine={}, versions={})
    results = Results(machine=here.machine, versions=here.versions, cells=results.cells)
    known = {} if again else {cell.key: len(cell.trials) for cell in results.cells}
    wanted = [
        question
        for question in _questions(places, protocols, methods)
        if len(question.asked) > known.get(question.key, 0)
    ]
    warm: set[str] = set()
    for index, question in enumerate(wanted):
        progress(
            Progress(
                stage=" ".join(question.key),
                done_count=index,
                total_count=len(wanted),
                fraction=index / len(wanted),
            )
        )
        if question.method.name not in warm:
            # What a method compiles at its first query is not timed.
            query = question.method.prepare(question.place.line_map)
            query(question.asked[0].read(), None)
            warm.add(question.method.name)
        results = results.with_cell(run_cell(question))
        write_results(path, results)
    return results


def _questions(
    places: Sequence[Place], protocols: Sequence[Protocol], methods: Sequence[Method]
) -> list[Question]:
    """All that applies, place by place."""
    return [
        Question(
            place=place, protocol=protocol, method=method, asked=_asked(place, protocol, places)
        )
        for place in places
        for protocol in protocols
        for method in methods
        if place.kind in (protocol.kinds or (place.kind,))
        and place.kind in (method.kinds or (place.kind,))
        and method.name in (protocol.methods or (method.name,))
    ]


def _asked(place: Place, protocol: Protocol, places: Sequence[Place]) -> tuple[Panorama, ...]:
    """The panoramas to ask the map of a place for; none where there is no other room."""
    if protocol.name != ELSEWHERE:
        return tuple(place.panoramas[: protocol.max_count])
    rooms = [other for other in places if other.kind == place.kind]
    at = [other.name for other in rooms].index(place.name)
    others = rooms[at + 1 :] + rooms[:at]
    if not others:
        return ()
    found = []
    for index in range(min(len(place.panoramas), protocol.max_count)):
        other = others[index % len(others)]
        found.append(other.panoramas[index % len(other.panoramas)])
    return tuple(found)


def run_cell(question: Question) -> Cell:
    """Ask for panoramas; each motion of the place is prepared once."""
    place, protocol, method = question.place, question.protocol, question.method
    asked = question.asked
    trials: dict[int, Trial] = {}
    prepare_seconds = []
    memory.reset_peak()
    for turn, motion in enumerate(protocol.motions):
        began_s = time.process_time()
        query = method.prepare(place.line_map.transformed(motion))
        prepare_seconds.append(time.process_time() - began_s)
        for index in range(turn, len(asked), len(protocol.motions)):
            panorama = asked[index]
            grey = panorama.read()
            if protocol.change is not None:
                grey = protocol.change(grey)
            truth = motion @ panorama.T_world_panorama
            prior = first_guess(truth, np.random.default_rng(index)) if protocol.has_prior else None
            began_s, clock_began_s = time.process_time(), time.perf_counter()
            answer = query(grey, prior)
            seconds = time.process_time() - began_s
            clock_seconds = time.perf_counter() - clock_began_s
            trials[index] = _trial(panorama.name, answer, truth, seconds, clock_seconds)
    return Cell(
        place=place.name,
        kind=place.kind,
        is_tuning=place.is_tuning,
        line_count=len(place.line_map),
        off_axes_deg=round(off_axes_deg(place.line_map.transformed(protocol.motions[0])), 2),
        protocol=protocol.name,
        method=method.name,
        prepare_seconds=round(statistics.median(prepare_seconds), 3),
        peak_rss_mib=_rounded(memory.peak_mib(), 0),
        trials=tuple(trials[index] for index in sorted(trials)),
    )


def _trial(name: str, answer: Answer, truth: SE3, seconds: float, clock_seconds: float) -> Trial:
    errors = [
        (
            float(np.degrees(rotation_errors_rad(pose, truth))),
            float(translation_errors_m(pose, truth)),
        )
        for pose in answer.poses
    ]
    nees = None
    if answer.poses and answer.covariance is not None:
        error = answer.poses[0].local(truth)
        nees = float(error @ np.linalg.solve(answer.covariance, error)) / len(error)
    return Trial(
        panorama=name,
        status=answer.status,
        rotation_deg=_rounded(errors[0][0], 4) if errors else None,
        translation_m=_rounded(errors[0][1], 5) if errors else None,
        is_listed=any(deg <= COARSE_DEG and m <= COARSE_M for deg, m in errors),
        score=_rounded(answer.score, 3),
        margin=_rounded(answer.margin, 3),
        nees=_rounded(nees, 3),
        seconds=round(seconds, 3),
        clock_seconds=round(clock_seconds, 3),
    )


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def first_guess(truth: SE3, rng: np.random.Generator) -> SE3:
    """A pose that far off in both ways, in any direction."""
    axis, direction = unit(rng.normal(size=(2, 3)))
    return truth.retract(np.concatenate([PRIOR_TURN_RAD * axis, PRIOR_SHIFT_M * direction]))


def off_axes_deg(line_map: LineMap) -> float:
    """The least rotation that lays the axes of the map's lines on those of the world."""
    segments = line_map.segments
    directions = unit(segments[:, 1] - segments[:, 0])
    longest = directions[np.argsort(-line_map.lengths_m, kind="stable")]
    frame = principal_frame(shared_directions(directions, line_map.lengths_m), longest)
    angles = [rotation_angle(turn @ frame) for turn in _axis_turns()]
    return float(np.degrees(min(angles)))


def _axis_turns() -> Iterator[Array]:
    """The 24 rotations that lay axes on axes."""
    for order in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (2, 1, 0), (1, 0, 2)):
        for sign in np.ndindex(2, 2, 2):
            turn = np.diag(1.0 - 2.0 * np.array(sign)) @ np.eye(3)[list(order)]
            if np.linalg.det(turn) > 0:
                yield turn


def find_methods(names: Sequence[str]) -> list[Method]:
    """The methods of these names, all without any."""
    return [METHODS[name] for name in names or METHODS]


def to_document(results: Results) -> dict[str, Any]:
    """What JSON can hold of them; trials are rows of values, to keep the file short."""
    names = [field.name for field in fields(Trial)]
    cells = [asdict(cell) for cell in results.cells]
    for cell in cells:
        cell["trials"] = [[trial[name] for name in names] for trial in cell["trials"]]
    return {
        "format": FORMAT,
        "machine": results.machine,
        "versions": results.versions,
        "trial": names,
        "cells": cells,
    }


def write_results(path: Path, results: Results) -> None:
    """Write one cell a line; the file is whole or as it was before."""
    document = to_document(results)
    cells = ",\n".join(_json(cell) for cell in document.pop("cells"))
    head = _json(document).removesuffix("}")
    with whole_file(path) as temporary:
        temporary.write_text(f'{head},"cells":[\n{cells}\n]}}\n', encoding="utf-8")


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def read_results(path: Path) -> Results:
    """Read what `write_results` wrote.

    Raises:
        InputError: no readable file, or no results of this format.
    """
    try:
        document: dict[str, Any] = json.loads(read_input(path, MAX_BYTES))
        if document["format"] != FORMAT:
            raise InputError(str(path), FORMAT, repr(document["format"]))
        names = document["trial"]
        cells = tuple(
            Cell(
                **(values | {"trials": tuple(_read_trial(names, row) for row in values["trials"])})
            )
            for values in document["cells"]
        )
        return Results(machine=document["machine"], versions=document["versions"], cells=cells)
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(str(path), f"JSON of format {FORMAT!r}", str(error)) from error


def _read_trial(names: list[str], row: list[Any]) -> Trial:
    return Trial(**dict(zip(names, row, strict=True)))
