"""Stages of one job that an earlier job may have done: which parameters each of them reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from roel_service.config.stages import Config, RefineRoundsConfig
from roel_service.mapping.front_end import Detected
from roel_service.mapping.refine import Refined
from roel_service.mapping.run import CountedEvents, MappingRun
from roel_service.mapping.stage_cache import (
    StageCache,
    detected_from_arrays,
    detected_to_arrays,
    refined_from_arrays,
    refined_to_arrays,
)
from roel_service.scene.camera import Camera
from roel_service.scene.trajectory import Trajectory

# Below every length: with this cap all observations weigh the same.
EQUAL_WEIGHTS_PX = 1.0


class CachedStages:
    """Finds what stages find, in the cache or by doing the work."""

    def __init__(self, run: MappingRun, cache: StageCache, config: Config) -> None:
        self._run = run
        self._cache = cache
        self._config = config

    def detected(
        self,
        find: Callable[[], Detected],
        counted: CountedEvents,
        trajectory: Trajectory,
        camera: Camera,
    ) -> Detected:
        """The lines of all frames."""
        config = self._config
        parameters = (
            config.frames,
            config.detect,
            config.plane_fit,
            config.refine.event_count_per_line,
            config.match_global if config.match_global.matches_points else None,
            config.runtime.seed,
        )
        arrays = self._cache.get("detect", parameters)
        if arrays is None:
            detected = find()
            self._cache.keep("detect", parameters, detected_to_arrays(detected, counted))
            return detected
        for stage in ("detect", "plane_fit"):
            self._run.skip(stage, len(arrays["t_us"]))
        return detected_from_arrays(arrays, counted, trajectory, camera)

    def triangulated(self, find: Callable[[], Refined]) -> Refined:
        """The first 3D lines."""
        config = self._config
        is_sampled = config.match_global.method == "sampled"
        stages = ("match_local", *(["match_global"] if is_sampled else []), "triangulate")
        parameters = (
            config.frames,
            config.detect,
            config.plane_fit,
            config.match_local,
            config.match_global if is_sampled else None,
            config.triangulate,
            _without_directions(triangulation_cost(config)),
            config.runtime.seed,
        )
        return self._refined("triangulate", stages, parameters, find)

    def associated(self, find: Callable[[], Refined]) -> Refined:
        """The lines of re-association, which refines them between its rounds."""
        config = self._config
        parameters = (
            config.frames,
            config.detect,
            config.plane_fit,
            config.match_local,
            config.match_global,
            config.triangulate,
            config.refine_rounds,
            config.runtime.seed,
        )
        return self._refined("match_global", ("match_global",), parameters, find)

    def _refined(
        self,
        name: str,
        stages: tuple[str, ...],
        parameters: object,
        find: Callable[[], Refined],
    ) -> Refined:
        arrays = self._cache.get(name, parameters)
        if arrays is None:
            refined = find()
            self._cache.keep(name, parameters, refined_to_arrays(refined, self._run.statuses))
            return refined
        refined, self._run.statuses = refined_from_arrays(arrays)
        for stage in stages:
            self._run.skip(stage, len(refined))
        return refined


def triangulation_cost(config: Config) -> RefineRoundsConfig:
    """What refines a hypothesis over its inliers.

    With the paper's gate it is the paper's cost: the sum of the line term alone, unweighted.
    """
    steps = config.triangulate.iteration_count
    if config.triangulate.gate == "pixel":
        return replace(config.refine_rounds, iteration_count=steps)
    return replace(
        config.refine_rounds,
        residual="grassmann",
        loss="squared",
        event_weight=0.0,
        max_length_weight_px=EQUAL_WEIGHTS_PX,
        iteration_count=steps,
    )


def _without_directions(config: RefineRoundsConfig) -> RefineRoundsConfig:
    """The same for lines that are refined on their own."""
    defaults = RefineRoundsConfig()
    return replace(
        config,
        direction_sigma_deg=defaults.direction_sigma_deg,
        direction_noise_px=defaults.direction_noise_px,
        max_direction_distance=defaults.max_direction_distance,
    )
