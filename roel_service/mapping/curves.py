"""Curved edges as polylines of bounded error, found by what straight lines leave over.

The paper names it a limitation that lines cannot stand for curves: chords of an arc differ from
frame to frame, and few agree. Here a curve is a chain of points instead. In some frames each point
of the short pieces (`curve_pieces`) gets the depth that the other frames agree on, since the poses
are known and the piece's speed limits the search (`curve_kernels`); depths are made to agree along
the chain (`curve_chains`). Each chain is then fitted, as a polyline or as a cubic Bezier curve, to
the pieces of all frames at once, and cut into segments. What lies along a line of the map, or along
a better supported curve, is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import BoolArray, FloatArray, IntArray
from roel_service.config.stages import Config, CurvesConfig
from roel_service.geometry import projection
from roel_service.geometry.segments import point_segment_distance
from roel_service.geometry.vectors import norm, unit
from roel_service.mapping import curve_kernels
from roel_service.mapping.curve_chains import SPACING_PX, linked, points_along, smoothed, thinned
from roel_service.mapping.curve_kernels import Field
from roel_service.mapping.curve_pieces import FRAME_STEP
from roel_service.mapping.frames import Frames, velocities
from roel_service.progress import StepCallback
from roel_service.scene.lines import LineMap, LineObservations
from roel_service.scene.trajectory import Trajectory

# Side of the cells that pieces are looked up by.
CELL_PX = 8.0
# Nothing is nearer than two thirds beyond what the tolerance of the speed allows.
SPEED_RANGE = 1.5
# A depth that deviates more from its neighbours' is another edge's; a chain may have so few
# points in a row without an own depth.
MAX_DEVIATION_PX = 2.0
MAX_GAP_COUNT = 3
# A polyline has a vertex for so many points before it is simplified; and how stiff it is, as a
# share of what the observations hold it with.
POINTS_PER_VERTEX = 4
STIFFNESS = 0.03
# Steps of the fit: as wide as the configuration says, then narrower by this share.
WIDE_STEP_COUNT, NARROW_STEP_COUNT = 3, 3
NARROWING = 0.75
# Keeps a fit regular along the curve, where nothing is observed; a share of what is.
RIDGE = 1e-3
# Of two curves with the same image, one goes; cosine of the largest angle between them.
MIN_ALONG_COSINE = 0.9
# Points of the shortest chain, and of the shortest rest of one beside what is in the map already.
CHAIN_POINT_COUNT = 8
MIN_POINT_COUNT = 5


@dataclass(frozen=True, eq=False, kw_only=True)
class _Curve:
    """Points of a curve, `n` of them in order.

    Attributes:
        points: (n, 3) m, world.
        pixel_m: (n,) size of a pixel at each point, as seen from the frame it was found in.
        frame_count: (n,) frames that saw each point; 0 before the fit.
        rms_px: (n,) of their residuals.
        sigma_m: (n,) standard deviation across the curve, for 1 px of noise an observation.
    """

    points: FloatArray
    pixel_m: FloatArray
    frame_count: IntArray
    rms_px: FloatArray
    sigma_m: FloatArray

    def __len__(self) -> int:
        return len(self.points)

    def take(self, index: IntArray) -> _Curve:
        """Some of the points."""
        return _Curve(**{name: value[index] for name, value in vars(self).items()})


def with_curves(
    line_map: LineMap,
    pieces: LineObservations,
    frames: Frames,
    trajectory: Trajectory,
    config: Config,
    progress: StepCallback,
) -> LineMap:
    """The map with the segments of curves behind its lines, which stay as they are.

    Args:
        line_map: straight lines.
        pieces: of every `FRAME_STEP`-th frame.
        frames, trajectory: poses; the trajectory gives the camera's velocity.
        config: `curves`, and the speed gate of `match_global`.
        progress: called for every frame that is looked at; may raise `Cancelled`.
    """
    if len(pieces) == 0:
        return line_map
    field = _field(pieces, frames, trajectory, config)
    found: list[_Curve] = []
    starts = range(0, len(frames), FRAME_STEP * config.curves.frame_stride)
    for frame in starts:
        progress(frame // starts.step, len(starts))
        for chain in _chains_of_frame(frame, pieces, frames, field, config.curves):
            fitted = _fitted(chain, field, config.curves)
            found += [fitted.take(run) for run in _good_runs(fitted, config.curves)]
    return _joined(line_map, _polylines(line_map, found, config.curves))


def _field(
    pieces: LineObservations, frames: Frames, trajectory: Trajectory, config: Config
) -> Field:
    span = pieces.segments_px[:, 1] - pieces.segments_px[:, 0]
    rows, columns = (int(np.ceil(size / CELL_PX)) for size in (frames.height, frames.width))
    start, members = curve_kernels.place_in_cells(
        pieces.frame,
        pieces.segments_px,
        len(frames),
        rows,
        columns,
        CELL_PX,
        config.curves.max_distance_px,
    )
    R = frames.T_world_camera.rotation
    velocity = 1e-3 * velocities(frames, trajectory)
    # Speeds that hold the camera's rotation say nothing about depths.
    tells_depth = config.frames.compensate_rotation
    max_speed_difference = config.match_global.max_speed_difference_px_per_ms
    return Field(
        start=start,
        members=members,
        rows=rows,
        columns=columns,
        cell_px=CELL_PX,
        middle=pieces.segments_px.mean(axis=1),
        direction=unit(span),
        half=0.5 * norm(span),
        speed=pieces.normal_speed_px_per_ms,
        rotation=np.ascontiguousarray(R),
        centre=np.ascontiguousarray(frames.T_world_camera.translation),
        velocity=np.einsum("nij,ni->nj", R, velocity),
        fx=float(frames.K[0, 0]),
        fy=float(frames.K[1, 1]),
        cx=float(frames.K[0, 2]),
        cy=float(frames.K[1, 2]),
        width=frames.width,
        height=frames.height,
        max_speed_difference=max_speed_difference if tells_depth else np.inf,
    )


def _chains_of_frame(
    frame: int, pieces: LineObservations, frames: Frames, field: Field, config: CurvesConfig
) -> Iterator[_Curve]:
    """The chains of one frame with their depths, cut where these do not agree."""
    others = _neighbours(frame, frames, config)
    baseline_m = norm(field.centre[others] - field.centre[frame]).max(initial=0.0)
    members = np.flatnonzero(pieces.frame == frame)
    if baseline_m == 0.0 or len(members) == 0:
        return
    points_px, piece = points_along(pieces.segments_px[members])
    piece = members[piece]
    flat = projection.normalized_from_pixel(points_px, frames.K)
    in_camera = np.column_stack([flat, np.ones(len(flat))])
    rays = in_camera @ field.rotation[frame].T
    step = 1.0 / (frames.focal_px * baseline_m)
    low, high = _depth_range(flat, piece, frame, field, frames, step)
    inverse_depth, information, support = curve_kernels.find_depths(
        field, frame, others, rays, low, high, step, config.max_distance_px
    )
    for polarity in (-1, 1):
        own = np.flatnonzero(pieces.polarity[piece] == polarity)
        if len(own) == 0:
            continue
        own = own[thinned(points_px[own], field.half[piece[own]])]
        for chain in linked(points_px[own], field.direction[piece[own]]):
            rows = own[chain]
            smooth, deviation_px = smoothed(
                inverse_depth[rows], information[rows], support[rows], SPACING_PX / frames.focal_px
            )
            agrees = (deviation_px < MAX_DEVIATION_PX) & (smooth > 0)
            agrees &= support[rows] >= config.min_frame_count
            for run in _runs(agrees, MAX_GAP_COUNT, CHAIN_POINT_COUNT):
                depth_m = 1.0 / np.maximum(smooth[run], step)
                points = field.centre[frame] + depth_m[:, None] * rays[rows[run]]
                yield _unfitted(points, depth_m * norm(in_camera[rows[run]]) / frames.focal_px)


def _neighbours(frame: int, frames: Frames, config: CurvesConfig) -> IntArray:
    """Frames with pieces on both sides of one."""
    steps = config.reach_frame_count // FRAME_STEP
    near = frame + FRAME_STEP * np.arange(-steps, steps + 1)
    return np.asarray(near[(near >= 0) & (near < len(frames)) & (near != frame)])


def _depth_range(
    flat: FloatArray, piece: IntArray, frame: int, field: Field, frames: Frames, step: float
) -> tuple[FloatArray, FloatArray]:
    """(n,) lowest and highest inverse depths, 1/m, that the speeds of (n,) pieces allow.

    Args:
        flat: (n, 2) normalised image positions.
        step: smallest inverse depth that is told from none.
    """
    w = field.velocity[frame]
    direction = field.direction[piece]
    motion = flat * w[2] - w[:2]
    rate = frames.focal_px * (motion[:, 1] * direction[:, 0] - motion[:, 0] * direction[:, 1])
    rate = np.where(np.abs(rate) > 1e-12, rate, 1e-12)
    tolerance = SPEED_RANGE * field.max_speed_difference / np.abs(rate)
    nearest = curve_kernels.MAX_HYPOTHESIS_COUNT * step
    low = np.clip(field.speed[piece] / rate - tolerance, step, nearest)
    high = np.clip(field.speed[piece] / rate + tolerance, step, nearest)
    return low, high


def _unfitted(points: FloatArray, pixel_m: FloatArray) -> _Curve:
    count = len(points)
    return _Curve(
        points=points,
        pixel_m=pixel_m,
        frame_count=np.zeros(count, np.int64),
        rms_px=np.zeros(count),
        sigma_m=np.zeros(count),
    )


def _runs(good: BoolArray, max_gap_count: int, min_count: int) -> list[IntArray]:
    """Index ranges that hold enough good points, over short gaps."""
    places = np.flatnonzero(good)
    parts = np.split(places, np.flatnonzero(np.diff(places) > max_gap_count + 1) + 1)
    return [np.arange(part[0], part[-1] + 1) for part in parts if len(part) >= min_count]


def _bernstein(share: FloatArray) -> FloatArray:
    """(n, 4) weights of the control points of a cubic Bezier curve at (n,) shares of its length."""
    rest = 1.0 - share
    return np.stack([rest**3, 3 * share * rest**2, 3 * share**2 * rest, share**3], axis=1)


def _hats(share: FloatArray) -> FloatArray:
    """(n, m) weights of the evenly spaced vertices of a polyline at (n,) shares of its length."""
    count = max(2, round(len(share) / POINTS_PER_VERTEX) + 1)
    distance = np.abs(share[:, None] * (count - 1) - np.arange(count))
    return np.asarray(np.maximum(0.0, 1.0 - distance))


# How each model makes a curve of its control points, and how stiff it is.
MODELS: dict[str, tuple[Callable[[FloatArray], FloatArray], float]] = {
    "polyline": (_hats, STIFFNESS),
    "bezier": (_bernstein, 0.0),
}


def _fitted(curve: _Curve, field: Field, config: CurvesConfig) -> _Curve:
    """The curve's model fitted to the pieces of all frames: Gauss-Newton with Tukey weights."""
    basis_of, stiffness = MODELS[config.method]
    basis = basis_of(_shares(curve.points))
    control = np.asarray(np.linalg.lstsq(basis, curve.points, rcond=None)[0], np.float64)
    frames = np.arange(0, len(field.centre), FRAME_STEP)
    gates = np.full(WIDE_STEP_COUNT + NARROW_STEP_COUNT, config.max_distance_px)
    gates[WIDE_STEP_COUNT:] *= NARROWING
    for gate in gates.tolist():
        points = basis @ control
        evidence = curve_kernels.gather_evidence(field, frames, points, _tangents(points), gate)
        step = _step(basis, control, evidence[0], evidence[1], stiffness)
        control = control - step
    points = basis @ control
    tangents = _tangents(points)
    information, _, support, in_view, mean_square = curve_kernels.gather_evidence(
        field, frames, points, tangents, gates[-1]
    )
    enough = support >= config.min_support_ratio * in_view
    return _Curve(
        points=points,
        pixel_m=curve.pixel_m,
        frame_count=np.where(enough, support, 0),
        rms_px=np.sqrt(mean_square),
        sigma_m=_sigma_m(information, tangents),
    )


def _shares(points: FloatArray) -> FloatArray:
    """(n,) how far along the chain each point lies, 0 to 1."""
    length = np.concatenate([[0.0], np.cumsum(norm(np.diff(points, axis=0)))])
    return np.asarray(length / length[-1])


def _tangents(points: FloatArray) -> FloatArray:
    """(n, 3) unit vectors along a chain."""
    return unit(np.gradient(points, axis=0))


def _step(
    basis: FloatArray,
    control: FloatArray,
    information: FloatArray,
    gradient: FloatArray,
    stiffness: float,
) -> FloatArray:
    """(m, 3) step of (m, 3) control points, of which the points are linear combinations."""
    count = len(control)
    system = np.einsum("ki,kj,krs->irjs", basis, basis, information)
    system = system.reshape(3 * count, 3 * count)
    right = np.einsum("ki,kr->ir", basis, gradient).ravel()
    scale = np.trace(system) / (3 * count)
    if scale == 0.0:  # nothing fits any more: the curve stays, and will not be supported
        return np.zeros_like(control)
    if stiffness and count > 2:
        bend = np.diff(np.eye(count), n=2, axis=0)
        stiff = stiffness * scale * np.kron(bend.T @ bend, np.eye(3))
        system, right = system + stiff, right + stiff @ control.ravel()
    system = system + RIDGE * scale * np.eye(3 * count)
    return np.asarray(np.linalg.solve(system, right).reshape(count, 3))


def _sigma_m(information: FloatArray, tangents: FloatArray) -> FloatArray:
    """(n,) largest standard deviation across the curve."""
    whole = np.trace(information, axis1=-2, axis2=-1)[:, None, None]
    along = tangents[:, :, None] * tangents[:, None, :]
    least = np.linalg.eigvalsh(information + whole * along)[:, 0]
    return np.asarray(1.0 / np.sqrt(np.maximum(least, 1e-12)))


def _good_runs(curve: _Curve, config: CurvesConfig) -> list[IntArray]:
    """The parts of a curve that enough frames saw, close enough and surely enough."""
    good = curve.frame_count >= config.min_frame_count
    good &= (curve.rms_px <= config.max_rms_px) & (curve.sigma_m <= config.max_sigma_m)
    return _runs(good, MAX_GAP_COUNT, CHAIN_POINT_COUNT)


def _polylines(line_map: LineMap, curves: list[_Curve], config: CurvesConfig) -> list[_Curve]:
    """Vertices of the curves, best supported first, without what is in the map or came before."""
    strength = np.array([curve.frame_count.sum() for curve in curves])
    polylines: list[_Curve] = []
    taken = line_map.segments
    for index in np.argsort(-strength, kind="stable"):
        curve = curves[index]
        hidden = _lies_along(curve, taken, config.overlap_distance_px)
        for run in _runs(~hidden, 0, MIN_POINT_COUNT):
            part = curve.take(run)
            vertices = part.take(_vertices(part, config.max_error_px))
            polylines.append(vertices)
            taken = np.concatenate([taken, _pieces_of(vertices.points)])
    return polylines


def _lies_along(curve: _Curve, segments: FloatArray, max_distance_px: float) -> BoolArray:
    """(n,) which points lie beside (S, 2, 3) segments that run the same way."""
    if len(segments) == 0:
        return np.zeros(len(curve), dtype=bool)
    directions = unit(segments[:, 1] - segments[:, 0])
    parallel = np.abs(_tangents(curve.points) @ directions.T) > MIN_ALONG_COSINE
    distance_m = point_segment_distance(curve.points[:, None], segments[None])
    near = distance_m < max_distance_px * curve.pixel_m[:, None]
    return np.asarray((near & parallel).any(axis=1))


def _vertices(curve: _Curve, max_error_px: float) -> IntArray:
    """Indices of the points that keep all others within an error (Douglas and Peucker, 1973)."""
    kept = {0, len(curve) - 1}
    open_spans = [(0, len(curve) - 1)]
    while open_spans:
        first, last = open_spans.pop()
        inner = np.arange(first + 1, last)
        if len(inner) == 0:
            continue
        chord = curve.points[[first, last]]
        error_px = point_segment_distance(curve.points[inner], chord) / curve.pixel_m[inner]
        worst = int(inner[error_px.argmax()])
        if error_px.max() > max_error_px:
            kept.add(worst)
            open_spans += [(first, worst), (worst, last)]
    return np.array(sorted(kept))


def _pieces_of(vertices: FloatArray) -> FloatArray:
    """(n - 1, 2, 3) segments between (n, 3) vertices."""
    return np.stack([vertices[:-1], vertices[1:]], axis=1)


def _joined(line_map: LineMap, polylines: list[_Curve]) -> LineMap:
    """The lines, then the segments of the polylines, each with the worse of its ends' figures."""

    def behind(column: FloatArray | IntArray, values: list[FloatArray]) -> FloatArray:
        return np.concatenate([column, *values])

    return LineMap(
        segments=behind(line_map.segments, [_pieces_of(p.points) for p in polylines]),
        observation_count=behind(
            line_map.observation_count,
            [np.minimum(p.frame_count[:-1], p.frame_count[1:]) for p in polylines],
        ),
        rms_residual_px=behind(
            line_map.rms_residual_px, [np.maximum(p.rms_px[:-1], p.rms_px[1:]) for p in polylines]
        ),
        sigma_m=behind(
            line_map.sigma_m, [np.maximum(p.sigma_m[:-1], p.sigma_m[1:]) for p in polylines]
        ),
    )
