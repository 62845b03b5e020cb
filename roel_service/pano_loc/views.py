"""How well a picture in some orientation agrees with what a map shows at places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.geometry.vectors import unit
from roel_service.pano_loc import views_kernels
from roel_service.pano_loc.arcs import PanoramaArcs

# Distances that part the shells, and what stands for each, m: walls hide what is far.
SHELL_ENDS_M = np.array([1.0, 1.5, 2.0, 3.0, 4.5, 6.5])
SHELL_MIDDLES_M = np.array([0.7, 1.25, 1.75, 2.5, 3.75, 5.5, 9.0])
# A line near by is seen with this chance, which falls by e over this distance.
SEEN_CHANCE, SEEN_REACH_M = 0.5, 2.0
# No step is painted by chance more rarely than this.
MIN_SHARE = 0.03
# Arcs belong to a class up to this angle.
CLASS_SINE = np.sin(np.deg2rad(4.0))
# Directions of arcs and of map lines are off by so much.
DIRECTION_SLACK_RAD = np.deg2rad(1.0)
# Places of which all lines are compared at once.
CHUNK_PLACE_COUNT = 256
# Where lines crowd, arcs lie on some of them by chance: of what takes up the same steps of so many
# bearings, the widest line alone counts by likelihood.
CLAIM_BEARING_COUNT = 2
# At this distance a picture is painted wide enough for a quarter of a cell of places.
SLACK_DISTANCE_M = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class ClassedLines:
    """Lines of shared directions, in the axes of their classes, longest first.

    Attributes:
        frames: (K, 3, 3) rows are the axes of each class, the last one its direction.
        which: (L,) class.
        feet: (L, 4) across, across, least and greatest along, m.
    """

    frames: FloatArray
    which: IntArray
    feet: FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class Views:
    """What a map shows at T places: see `views_kernels`.

    Attributes:
        slots: (T, M) int32 class and bearing.
        words, fronts: (T, M) uint64 elevations; those that wider lines do not take up, too.
        kinds: (T, M) uint8 class and distance.
        sizes, front_sizes: (T, N) steps that lines of each kind take up.
        bearing_count: of each class.
    """

    slots: Array
    words: Array
    fronts: Array
    kinds: Array
    sizes: FloatArray
    front_sizes: FloatArray
    bearing_count: int


def class_frames(shared: FloatArray, frame: FloatArray) -> FloatArray:
    """(K, 3, 3) axes of (K, 3) unit directions that turn with the map's (3, 3) frame."""
    frames = np.empty((len(shared), 3, 3))
    for k, direction in enumerate(shared):
        axis = frame[np.abs(frame @ direction).argmin()]
        across = unit(axis - (axis @ direction) * direction)
        frames[k] = across, np.cross(direction, across), direction
    return frames


def classed_lines(segments: FloatArray, channel: IntArray, frames: FloatArray) -> ClassedLines:
    """(L, 2, 3) segments, m, of classes of which -1 is none."""
    members = np.flatnonzero(channel >= 0)
    which = channel[members]
    ends = np.einsum("lij,lej->lei", frames[which], segments[members])
    along = ends[:, :, 2]
    across = ends[:, :, :2].mean(axis=1)
    feet = np.column_stack([across, along.min(axis=1), along.max(axis=1)])
    return ClassedLines(frames=frames, which=which, feet=np.ascontiguousarray(feet))


def views_from(
    lines: ClassedLines, places: FloatArray, bearing_count: int, line_count: int
) -> Views:
    """What lines look like from (T, 3) places, m: from each, those that take up most of its sphere.

    Lines of other rooms are far, and take up little.
    """
    inside = _inside(lines, places)
    chosen = np.concatenate(
        [
            widest(lines, inside[first : first + CHUNK_PLACE_COUNT], line_count)
            for first in range(0, len(places), CHUNK_PLACE_COUNT)
        ]
        or [np.empty((0, line_count), np.int64)]
    )
    return _views_of(lines, inside, chosen, bearing_count, CLAIM_BEARING_COUNT)


def views_around(
    lines: ClassedLines,
    places: FloatArray,
    bearing_count: int,
    line_count: int,
    claim_bearing_count: int,
) -> Views:
    """The same from (T, 3) places around one, whose lines they share."""
    inside = _inside(lines, places)
    middle = inside.mean(axis=0, keepdims=True)
    chosen = np.repeat(widest(lines, middle, line_count), len(places), axis=0)
    return _views_of(lines, inside, chosen, bearing_count, claim_bearing_count)


def _inside(lines: ClassedLines, places: FloatArray) -> FloatArray:
    """(T, K, 3) places in the axes of each class."""
    return np.ascontiguousarray(np.einsum("kij,tj->tki", lines.frames, places))


def widest(lines: ClassedLines, inside: FloatArray, count: int) -> IntArray:
    """(T, C) lines that take up most of the sphere, seen from (T, K, 3) places, widest first."""
    span_rad = views_kernels.spans(lines.feet, lines.which, inside)
    count = min(count, span_rad.shape[1])
    chosen = np.argpartition(-span_rad, max(count - 1, 0), axis=1)[:, :count]
    order = np.argsort(-np.take_along_axis(span_rad, chosen, axis=1), axis=1, kind="stable")
    return np.asarray(np.take_along_axis(chosen, order, axis=1))


def _views_of(
    lines: ClassedLines,
    inside: FloatArray,
    chosen: IntArray,
    bearing_count: int,
    claim_bearing_count: int,
) -> Views:
    """What (T, M) chosen lines look like from (T, K, 3) places."""
    slots, words, fronts, kinds = views_kernels.views(
        lines.feet, lines.which, inside, chosen, bearing_count, claim_bearing_count, SHELL_ENDS_M
    )
    everything = np.full(len(lines.frames) * bearing_count, ~np.uint64(0))
    sizes, front_sizes = (
        _sizes(slots, steps, kinds, everything, len(lines.frames)) for steps in (words, fronts)
    )
    return Views(
        slots=slots,
        words=words,
        fronts=fronts,
        kinds=kinds,
        sizes=sizes,
        front_sizes=front_sizes,
        bearing_count=bearing_count,
    )


def _sizes(slots: Array, words: Array, kinds: Array, shown: Array, class_count: int) -> FloatArray:
    kind_count = class_count * len(SHELL_MIDDLES_M)
    return np.asarray(views_kernels.sizes(slots, words, kinds, shown, kind_count))


@dataclass(frozen=True, eq=False, kw_only=True)
class Pane:
    """A picture in one orientation.

    Attributes:
        words: (K, B) uint64, painted elevations.
        shown: (K, B) uint64, what the picture shows; None if it shows everything.
        share: (N,) chance that a step of each kind of line is painted.
        gain, loss: (N,) log-likelihood ratios of a step that is painted, and of one that is not.
    """

    words: Array
    shown: Array | None
    share: FloatArray
    gain: FloatArray
    loss: FloatArray


def pane_of(
    arcs: PanoramaArcs, rotation: FloatArray, frames: FloatArray, step_m: float, bearing_count: int
) -> Pane:
    """A picture turned into the world, painted for places that are a step apart."""
    words = views_kernels.paint(
        arcs.starts @ rotation.T,
        arcs.ends @ rotation.T,
        arcs.normals @ rotation.T,
        frames,
        CLASS_SINE,
        DIRECTION_SLACK_RAD + 0.25 * step_m / SLACK_DISTANCE_M,
        bearing_count,
    )
    shown = None
    if len(arcs.sides):
        shown = views_kernels.paint_view(arcs.sides @ rotation.T, frames, bearing_count)
    everything = np.full_like(words, ~np.uint64(0))
    painted = views_kernels.painted_share(words, everything if shown is None else shown)
    share = np.maximum(painted, MIN_SHARE)[:, None]
    seen = SEEN_CHANCE * np.exp(-SHELL_MIDDLES_M / SEEN_REACH_M)
    gain = np.log((seen + (1.0 - seen) * share) / share)
    loss = np.broadcast_to(np.log(1.0 - seen), gain.shape)
    return Pane(
        words=words,
        shown=shown,
        share=np.repeat(share[:, 0], len(seen)),
        gain=gain.ravel(),
        loss=loss.ravel(),
    )


def agreement(views: Views, panes: Sequence[Pane], chosen: IntArray | None = None) -> FloatArray:
    """(R, C, 2) scores of places in R orientations: beyond chance, and by likelihood.

    The first is right where all lines can be seen, the second where walls hide most of them.

    Args:
        views: of T places.
        panes: of R orientations.
        chosen: (R, C) places that are asked for in each orientation; None for all.
    """
    if chosen is None:
        chosen = np.broadcast_to(np.arange(len(views.words)), (len(panes), len(views.words)))
    share, gain, loss = (
        np.stack([getattr(pane, name) for pane in panes]) for name in ("share", "gain", "loss")
    )
    words = np.stack([pane.words.ravel() for pane in panes])
    total = views_kernels.painted_steps(
        views.slots,
        views.words,
        views.fronts,
        views.kinds,
        words,
        gain - loss,
        np.ascontiguousarray(chosen),
    )
    every = [_sizes_in(views, pane) for pane in panes]
    sizes = [size[places] for (size, _), places in zip(every, chosen, strict=True)]
    fronts = [size[places] for (_, size), places in zip(every, chosen, strict=True)]
    expected = np.stack([size @ column for size, column in zip(sizes, share, strict=True)])
    missed = np.stack([size @ column for size, column in zip(fronts, loss, strict=True)])
    size = np.maximum(np.stack([size.sum(axis=1) for size in sizes]), 1.0)
    return np.stack([(total[:, :, 0] - expected) / np.sqrt(size), total[:, :, 1] + missed], axis=2)


def _sizes_in(views: Views, pane: Pane) -> tuple[FloatArray, FloatArray]:
    """(T, N) sizes of the parts of lines that a picture shows; all, and those in front."""
    if pane.shown is None:
        return views.sizes, views.front_sizes
    shown, class_count = pane.shown.ravel(), len(pane.words)
    return (
        _sizes(views.slots, views.words, views.kinds, shown, class_count),
        _sizes(views.slots, views.fronts, views.kinds, shown, class_count),
    )
