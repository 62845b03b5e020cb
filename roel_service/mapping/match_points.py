"""Line correspondences from point matches between event images.

Paper: "Local and Global Line Matching", the global part: a matching model finds the same points in
two event images, and two lines correspond when many of these points lie near both.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.config.stages import Config, MatchGlobalConfig
from roel_service.errors import ConfigError
from roel_service.geometry.segments import point_segment_distance
from roel_service.mapping.frames import EventFrame
from roel_service.mapping.representations import event_images
from roel_service.mapping.views import Views

# Frames whose features are kept: pairs come in the order of their first frame, so that a frame's
# partners are met again soon. All features of a recording would not fit into memory.
KEPT_FRAME_COUNT = 32


class PointMatcher(Protocol):
    """Finds the same points in two grey images; what one image alone can tell is asked for once."""

    def features(self, grey: Array) -> Any:
        """What `match` needs to know of an (H, W) uint8 image."""
        ...

    def match(self, features_i: Any, features_j: Any) -> FloatArray:
        """(n, 4) points [x_i, y_i, x_j, y_j] in px, pixel centres at integers."""
        ...


def point_matcher(config: MatchGlobalConfig) -> PointMatcher:
    """The learned matcher that the configuration names.

    Raises:
        ConfigError: the extra `learned` is not installed, or there is no usable checkpoint.
    """
    if find_spec("kornia") is None:
        expected = f"the extra `learned` installed for {config.matcher}: `make learned`"
        raise ConfigError("match_global.matcher", expected, "no package kornia")
    # torch takes seconds to load; only those who match points wait for it.
    from roel_service.mapping.learned import MATCHERS

    return MATCHERS[config.matcher](config)


def images_to_match(index: int, frame: EventFrame, config: Config) -> tuple[Array, ...]:
    """Images, (H, W) uint8, that a point matcher gets of frame `index`.

    They are the detector's representations of the longest window; none of a frame that is not
    sampled, or when nothing asks for point matches.
    """
    settings = config.match_global
    if not settings.matches_points or index % settings.frame_stride:
        return ()
    longest = dataclasses.replace(frame, windows=frame.windows[-1:])
    return tuple(image.grey for image in event_images(longest, config.detect))


class PointLineMatcher:
    """A `LineMatcher` that pools the point matches of all representations of two frames."""

    def __init__(
        self,
        points: PointMatcher,
        images: Mapping[int, Sequence[Array]],
        views: Views,
        config: MatchGlobalConfig,
    ) -> None:
        """Prepare to match the frames that have images.

        Args:
            points: matches two images.
            images: of each sampled frame, in one order of representations.
            views: of all observations, in the order of frames.
            config: how many points, and how near.
        """
        self._points = points
        self._images = images
        self._views = views
        self._config = config
        self._features = lru_cache(maxsize=KEPT_FRAME_COUNT)(self._features_of)

    def match(self, frame_i: int, frame_j: int) -> IntArray:
        """See `LineMatcher`; a line may correspond with several."""
        first_i, stop_i = np.searchsorted(self._views.frame, [frame_i, frame_i + 1])
        first_j, stop_j = np.searchsorted(self._views.frame, [frame_j, frame_j + 1])
        found = lines_near_matches(
            self._pooled_matches(frame_i, frame_j),
            self._views.segment_px[first_i:stop_i],
            self._views.segment_px[first_j:stop_j],
            self._config,
        )
        return np.asarray(found + np.array([first_i, first_j]))

    def _pooled_matches(self, frame_i: int, frame_j: int) -> FloatArray:
        """(n, 4) matches; a frame with an empty window has no images, hence no matches."""
        both = zip(self._features(frame_i), self._features(frame_j), strict=False)
        matches = [self._points.match(features_i, features_j) for features_i, features_j in both]
        return np.concatenate([np.empty((0, 4)), *matches])

    def _features_of(self, frame: int) -> list[Any]:
        return [self._points.features(grey) for grey in self._images[frame]]


def lines_near_matches(
    matches_px: FloatArray,
    segments_i_px: FloatArray,
    segments_j_px: FloatArray,
    config: MatchGlobalConfig,
) -> IntArray:
    """(n, 2) rows of the segments that at least `min_point_match_count` matches have in common.

    A match counts for a pair when its point in either image is within `point_distance_px` of the
    segment there.

    Args:
        matches_px: (M, 4) [x_i, y_i, x_j, y_j].
        segments_i_px, segments_j_px: (I, 2, 2) and (J, 2, 2).
        config: the two bounds.
    """
    near_i = _near(matches_px[:, :2], segments_i_px, config.point_distance_px)
    near_j = _near(matches_px[:, 2:], segments_j_px, config.point_distance_px)
    common_count = near_i.T @ near_j
    return np.asarray(np.argwhere(common_count >= config.min_point_match_count), np.int64)


def _near(points_px: FloatArray, segments_px: FloatArray, distance_px: float) -> FloatArray:
    """(M, S) 1 where the point is near the segment, else 0."""
    distances_px = point_segment_distance(points_px[:, None], segments_px[None])
    return np.asarray(distances_px <= distance_px, dtype=np.float64)
