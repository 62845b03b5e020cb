"""A line map onto a point cloud, by any of the methods."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import RegisterConfig
from roel_service.errors import CloudError
from roel_service.geometry.se3 import SE3
from roel_service.geometry.segments import sample_segments
from roel_service.register.align import Level, align
from roel_service.register.alignment import Alignment
from roel_service.register.guesses import Guess, guesses_anywhere, guesses_near
from roel_service.register.point_to_point import align_points
from roel_service.register.prepare import PreparedCloud, prepare_cloud, prepare_map, require_points
from roel_service.register.source import Source, require_lines, source_of_cloud, source_of_map
from roel_service.register.verdict import competing, judge
from roel_service.register.vertical import Vertical
from roel_service.scene.clouds import PointCloud
from roel_service.scene.lines import LineMap
from roel_service.scene.results import RegistrationResult, StopReason

METHODS = ("auto", "point", "plane", "line", "global")

# Two maps of one place differ in size, but not like this.
MAX_SIZE_RATIO = 100.0

# Guesses are followed up with few samples and short steps: a voting cell has to be overcome.
FOLLOW_UP_SCALES = 6.0, 1.5  # in distances between points
FOLLOW_UP_SAMPLE_COUNT, FOLLOW_UP_STEP_COUNT, FOLLOW_UP_JUDGED_COUNT = 400, 10, 800
# The last levels start where the follow-up ended.
SETTLING_SAMPLE_COUNT, LAST_SAMPLE_COUNT = 1500, 6000
LAST_FIRST_SCALE = 1.25
# Planes of a sparse scan are no better than this against the distance of its points.
LAST_SCALE = 0.5

# Methods that follow a first guess by one kind of pull: weights of surfaces and of creases.
PULLS = {"plane": (1.0, 0.0), "line": (0.0, 1.0)}
START_SCALE_M, START_SCALE_DECAY, START_STEP_COUNT = 0.5, 0.9, 80


def register_map(
    source: LineMap | PreparedCloud,
    target: PointCloud | LineMap | PreparedCloud,
    config: RegisterConfig,
    *,
    method: str = "auto",
    T_init: SE3 | None = None,
    vertical: Vertical | None = None,
) -> RegistrationResult:
    """Where a line map lies in a cloud, or in another map.

    Args:
        source: the map; a prepared cloud is registered by its points and creases.
        target: the cloud or map; prepare it once for many registrations.
        config: parameters.
        method: one of `METHODS`.
        T_init: first T_target_source; the identity by default, and not looked at by `global`.
        vertical: which way is up, for `global`; None: along z if `config.gravity_aligned`, else unknown.

    Raises:
        NoAnswerError: fewer than three lines.
        CloudError: a cloud in another unit than the map, or of too few points.
    """
    moving = source_of_map(source) if isinstance(source, LineMap) else source_of_cloud(source)
    if not isinstance(target, PreparedCloud):
        points = _points(target) if isinstance(target, PointCloud) else _ends(target)
        if not config.estimate_scale:
            require_same_unit(moving, points)
        target = _prepared(target, config)
    elif not config.estimate_scale:
        require_same_unit(moving, target.points)
    T_init = T_init or SE3.identity()
    if method == "point":
        ended = _by_points(source, moving, target, T_init, config)
        return judge([ended], moving, target, config)
    if method in PULLS:
        ended = _from_start(method, moving, target, T_init, config)
        return judge([ended], moving, target, config)
    if method == "global":
        if vertical is None and config.gravity_aligned:
            vertical = Vertical()
        guesses = guesses_anywhere(moving, target, config, vertical)
    else:
        guesses = guesses_near(moving, target, T_init, config)
    return _best(guesses, moving, target, config)


def _points(cloud: PointCloud) -> Array:
    """(N, 3) enough points to be a place."""
    require_points(cloud)
    return cloud.points


def _ends(line_map: LineMap) -> FloatArray:
    """(2 L, 3) the ends of all lines."""
    require_lines(line_map)
    return line_map.segments.reshape(-1, 3)


def _prepared(target: PointCloud | LineMap, config: RegisterConfig) -> PreparedCloud:
    if isinstance(target, LineMap):
        return prepare_map(target, config)
    return prepare_cloud(target, config)


def _best(
    guesses: list[Guess], source: Source, target: PreparedCloud, config: RegisterConfig
) -> RegistrationResult:
    """Follow up all guesses a little, and those that compete with the best one to their ends."""
    first_scale, last_scale = (scale * target.resolution_m for scale in FOLLOW_UP_SCALES)
    follow_up = Level(
        first_scale_m=first_scale,
        last_scale_m=last_scale,
        sample_count=FOLLOW_UP_SAMPLE_COUNT,
        step_count=FOLLOW_UP_STEP_COUNT,
        estimate_scale=config.estimate_scale,
    )
    followed = [align(source.samples, target, _start(guess), follow_up) for guess in guesses]
    rivals = competing(followed, source, target, config, FOLLOW_UP_JUDGED_COUNT)
    settled = [_settled(rival.alignment, source, target, config) for rival in rivals]
    return judge(settled, source, target, config)


def _settled(
    alignment: Alignment, source: Source, target: PreparedCloud, config: RegisterConfig
) -> Alignment:
    """Down to the last scale, where the follow-up ended."""
    for level in _last_levels(config, target.resolution_m):
        alignment = align(source.samples, target, alignment, level)
    return alignment


def _from_start(
    method: str, source: Source, target: PreparedCloud, T_init: SE3, config: RegisterConfig
) -> Alignment:
    """Surfaces alone, or creases alone, from the first guess."""
    surface_weight, crease_weight = PULLS[method]
    level = Level(
        first_scale_m=START_SCALE_M,
        last_scale_m=max(config.last_scale_m, LAST_SCALE * target.resolution_m),
        sample_count=SETTLING_SAMPLE_COUNT,
        step_count=START_STEP_COUNT,
        scale_decay=START_SCALE_DECAY,
        estimate_scale=config.estimate_scale,
        surface_weight=surface_weight,
        crease_weight=crease_weight,
    )
    start = Guess(T_target_source=T_init, scale=1.0, votes=0.0)
    return align(source.samples, target, _start(start), level)


def _last_levels(config: RegisterConfig, resolution_m: float) -> tuple[Level, Level]:
    """Down to the last scale with some of the samples, then with all of them."""
    last_scale_m = max(config.last_scale_m, LAST_SCALE * resolution_m)
    settling = Level(
        first_scale_m=LAST_FIRST_SCALE * resolution_m,
        last_scale_m=last_scale_m,
        sample_count=SETTLING_SAMPLE_COUNT,
        step_count=config.step_count,
        estimate_scale=config.estimate_scale,
    )
    all_samples = replace(settling, first_scale_m=last_scale_m, sample_count=LAST_SAMPLE_COUNT)
    return settling, all_samples


def _start(guess: Guess) -> Alignment:
    return Alignment(
        T_target_source=guess.T_target_source,
        scale=guess.scale,
        stop_reason=StopReason.ITERATION_LIMIT,
        iteration_count=0,
    )


def _by_points(
    source: LineMap | PreparedCloud,
    moving: Source,
    target: PreparedCloud,
    T_init: SE3,
    config: RegisterConfig,
) -> Alignment:
    points = moving.samples.points
    if isinstance(source, LineMap):
        points, _ = sample_segments(source.segments, config.sample_spacing_m)
    return align_points(
        points, target.points, T_init, config.point_gate_m, config.point_iteration_count
    )


def require_same_unit(source: Source, points: Array) -> None:
    """Refuse a cloud that is so much larger or smaller that its unit must be another one."""
    source_m, target_m = (float(np.ptp(p, axis=0).max()) for p in (source.samples.points, points))
    ratio = target_m / max(source_m, 1e-9)
    if 1.0 / MAX_SIZE_RATIO < ratio < MAX_SIZE_RATIO:
        return
    expected = f"a cloud in metres, as the map of {source_m:.3g} m is"
    found = f"a size of {target_m:.3g}"
    if abs(abs(np.log10(max(ratio, 1e-9))) - 3.0) < 1.0:
        unit = "millimetres and metres" if ratio > 1.0 else "metres and millimetres"
        found += f": a factor of about 1000, as between {unit}"
    raise CloudError("cloud", expected, found, reason="CLOUD_UNIT")
