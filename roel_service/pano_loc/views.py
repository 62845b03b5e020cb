"""How well a picture in some orientation agrees with what a map shows at places."""

from __future__ import annotations

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
# Where lines crowd, arcs lie on some of them by chance: of what takes up the same steps of so many
# bearings, the widest line alone counts by likelihood.
CLAIM_BEARING_COUNT = 2
# Columns of `agreement`.
BEYOND_CHANCE, BY_LIKELIHOOD = 0, 1
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
        slots: (T, M) uint16 class and bearing.
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
    chosen = views_kernels.widest(lines.feet, lines.which, inside, line_count)
    return _views_of(lines, inside, chosen, bearing_count)


def _inside(lines: ClassedLines, places: FloatArray) -> FloatArray:
    """(T, K, 3) places in the axes of each class."""
    return np.ascontiguousarray(np.einsum("kij,tj->tki", lines.frames, places))


def _views_of(lines: ClassedLines, inside: FloatArray, chosen: Array, bearing_count: int) -> Views:
    """What (T, M) chosen lines look like from (T, K, 3) places."""
    slots, words, fronts, kinds = views_kernels.views(
        lines.feet, lines.which, inside, chosen, bearing_count, CLAIM_BEARING_COUNT, SHELL_ENDS_M
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
class Strokes:
    """Arcs of a picture in one orientation, about the directions of their classes.

    Attributes:
        frames: (K, 3, 3) of the classes.
        which: (A,) class, -1 for none.
        bearings: (A,) rad.
        words: (A,) uint64 elevations.
        sides: (V, 3) of the picture, world.
    """

    frames: FloatArray
    which: IntArray
    bearings: FloatArray
    words: Array
    sides: FloatArray


def strokes_of(arcs: PanoramaArcs, rotation: FloatArray, frames: FloatArray) -> Strokes:
    """A picture turned into the world by a (3, 3) rotation."""
    which, bearings, words = views_kernels.strokes(
        arcs.starts, arcs.ends, arcs.normals, rotation, frames, CLASS_SINE
    )
    return Strokes(
        frames=frames,
        which=which,
        bearings=bearings,
        words=words,
        sides=arcs.sides @ rotation.T,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Pane:
    """A picture in one orientation, painted.

    Attributes:
        words: (K, B) uint64, painted elevations.
        shown: (K, B) uint64, what the picture shows.
        shows_everything: whether it does.
        share: (N,) chance that a step of each kind of line is painted.
        gain, loss: (N,) log-likelihood ratios of a step that is painted, and of one that is not.
    """

    words: Array
    shown: Array
    shows_everything: bool
    share: FloatArray
    gain: FloatArray
    loss: FloatArray


def pane_of(strokes: Strokes, step_m: float, bearing_count: int) -> Pane:
    """Strokes painted for places that are a step apart."""
    words = views_kernels.paint(
        strokes.which,
        strokes.bearings,
        strokes.words,
        len(strokes.frames),
        bearing_count,
        DIRECTION_SLACK_RAD + 0.25 * step_m / SLACK_DISTANCE_M,
    )
    shown = np.full_like(words, ~np.uint64(0))
    if len(strokes.sides):
        shown = views_kernels.paint_view(strokes.sides, strokes.frames, bearing_count)
    share = np.maximum(views_kernels.painted_share(words, shown), MIN_SHARE)[:, None]
    seen = SEEN_CHANCE * np.exp(-SHELL_MIDDLES_M / SEEN_REACH_M)
    gain = np.log((seen + (1.0 - seen) * share) / share)
    loss = np.broadcast_to(np.log(1.0 - seen), gain.shape)
    return Pane(
        words=words,
        shown=shown,
        shows_everything=len(strokes.sides) == 0,
        share=np.repeat(share[:, 0], len(seen)),
        gain=gain.ravel(),
        loss=loss.ravel(),
    )


def agreement(views: Views, pane: Pane, chosen: IntArray | None = None) -> FloatArray:
    """(C, 2) scores of places in one orientation: beyond chance, and by likelihood.

    The first is right where all lines can be seen, the second where walls hide most of them.

    Args:
        views: of T places.
        pane: the picture.
        chosen: (C,) places that are asked for; None for all.
    """
    asked = slice(None) if chosen is None else chosen
    total = views_kernels.painted_steps(
        views.slots,
        views.words,
        views.fronts,
        views.kinds,
        pane.words.ravel(),
        pane.gain - pane.loss,
        np.arange(len(views.words)) if chosen is None else chosen,
    )
    sizes, front_sizes = (sizes[asked] for sizes in _sizes_in(views, pane))
    beyond_chance = total[:, 0] - sizes @ pane.share
    beyond_chance /= np.sqrt(np.maximum(sizes.sum(axis=1), 1.0))
    return np.stack([beyond_chance, total[:, 1] + front_sizes @ pane.loss], axis=1)


def best_place(
    lines: ClassedLines,
    places: FloatArray,
    line_count: int,
    claim_bearing_count: int,
    pane: Pane,
    kind: int,
) -> tuple[int, float]:
    """Which of (T, 3) places, m, around one agrees best, and its score.

    Args:
        lines: of the map.
        places: which share the lines that are widest from their middle.
        line_count: that are compared.
        claim_bearing_count: of what takes up the same steps of so many bearings, the widest line
            alone counts by likelihood.
        pane: the picture.
        kind: column of `agreement`.
    """
    index, score = views_kernels.best_place(
        lines.feet,
        lines.which,
        _inside(lines, places),
        line_count,
        claim_bearing_count,
        SHELL_ENDS_M,
        pane.words,
        pane.shown,
        np.stack([pane.share, pane.gain - pane.loss, pane.loss]),
        kind == BY_LIKELIHOOD,
    )
    return int(index), float(score)


def _sizes_in(views: Views, pane: Pane) -> tuple[FloatArray, FloatArray]:
    """(T, N) sizes of the parts of lines that a picture shows; all, and those in front."""
    if pane.shows_everything:
        return views.sizes, views.front_sizes
    shown, class_count = pane.shown.ravel(), len(pane.words)
    return (
        _sizes(views.slots, views.words, views.kinds, shown, class_count),
        _sizes(views.slots, views.fronts, views.kinds, shown, class_count),
    )
