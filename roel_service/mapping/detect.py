"""Line detection on event images, over several windows and representations.

Paper: "Multi-window, Multi-representation Line Detection". A detection is a seed for the plane
fit, never a measurement: detectors answer both flanks of every ridge.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import DetectConfig
from roel_service.errors import ConfigError
from roel_service.mapping import detect_kernels
from roel_service.mapping.frames import UNKNOWN_POLARITY
from roel_service.mapping.representations import EventImage

# OpenCV's LSD at its default scale of 0.8 puts lines this far to the upper left (px).
LSD_OFFSET_PX = -0.125
# Every OpenCV wheel writes into the folder cv2; what was installed last stays.
REMEDY = "pip install --force-reinstall --no-deps opencv-contrib-python-headless brings it back"
# Shortest chain of edge pixels that EDLines looks at.
MIN_PATH_PX = 10


@dataclass(frozen=True, eq=False, kw_only=True)
class Seeds:
    """Detected lines of one frame, longest first.

    Attributes:
        segments_px: (S, 2, 2) [line, endpoint, xy].
        polarity: (S,) int8, -1 or +1; 0 where the image showed both.
    """

    segments_px: FloatArray
    polarity: Array

    def __len__(self) -> int:
        return len(self.polarity)


class LineDetector(Protocol):
    """Finds straight edges in a grey image."""

    def detect(self, grey: Array) -> FloatArray:
        """(S, 2, 2) segments in px, pixel centres at integers, in an (H, W) uint8 image."""
        ...


class EDLines:
    """Edge Drawing Lines (Akinlar and Topal, 2011), as OpenCV implements it."""

    def __init__(self, config: DetectConfig) -> None:
        """Take the settings of the configuration.

        Raises:
            ConfigError: another OpenCV wheel has overwritten the one that brings EDLines.
        """
        if not hasattr(getattr(cv2, "ximgproc", None), "createEdgeDrawing"):
            expected = f"an OpenCV with edlines; {REMEDY}"
            raise ConfigError("detect.detector", expected, "cv2 of another OpenCV package")
        self._params = cv2.ximgproc.EdgeDrawing.Params()
        self._params.EdgeDetectionOperator = cv2.ximgproc.EDGE_DRAWING_SOBEL
        self._params.GradientThresholdValue = config.gradient_threshold
        self._params.AnchorThresholdValue = config.anchor_threshold
        self._params.MinPathLength = MIN_PATH_PX
        self._params.LineFitErrorThreshold = config.line_fit_error_px
        self._params.ScanInterval = 1
        self._params.NFAValidation = True
        # The images are smooth already.
        self._params.Sigma = 0.0

    def detect(self, grey: Array) -> FloatArray:
        return _segments(self._drawn(grey).detectLines())

    def chains(self, grey: Array) -> list[Array]:
        """(n, 2) int pixels of each edge, neighbour by neighbour, before lines are looked for."""
        return [np.asarray(chain) for chain in self._drawn(grey).getSegments()]

    def _drawn(self, grey: Array) -> cv2.ximgproc.EdgeDrawing:
        # A detector keeps the last image's edges; a new one makes calls from threads independent.
        drawing = cv2.ximgproc.createEdgeDrawing()
        drawing.setParams(self._params)
        drawing.detectEdges(grey)
        return drawing


class LSD:
    """Line Segment Detector (von Gioi et al., 2010), as OpenCV implements it."""

    def detect(self, grey: Array) -> FloatArray:
        lines = cv2.createLineSegmentDetector().detect(grey)[0]
        return _segments(lines) - LSD_OFFSET_PX


def _segments(lines: Array | None) -> FloatArray:
    if lines is None:
        return np.empty((0, 2, 2))
    return np.asarray(lines, dtype=np.float64).reshape(-1, 2, 2)


def line_detector(config: DetectConfig) -> LineDetector:
    """The detector that the configuration names."""
    return EDLines(config) if config.detector == "edlines" else LSD()


def detect_lines(
    images: Iterable[EventImage], detector: LineDetector, config: DetectConfig
) -> Seeds:
    """Lines of all windows and representations of one frame, each kept once."""
    segments, labels = [np.empty((0, 2, 2))], [np.empty(0, np.int8)]
    for image in images:
        found = detector.detect(image.grey)
        min_length_px = max(
            config.min_length_px, config.min_length_width_share * image.grey.shape[1]
        )
        found = found[_lengths(found) >= min_length_px]
        label = UNKNOWN_POLARITY if config.merge_across_polarities else image.polarity
        segments.append(found)
        labels.append(np.full(len(found), label, np.int8))
    return merge_seeds(np.concatenate(segments), np.concatenate(labels), config)


def merge_seeds(segments_px: FloatArray, polarity: Array, config: DetectConfig) -> Seeds:
    """Longest first; a line that lies along a longer one of the same label is dropped.

    Along means: the one-way perpendicular distance, the larger distance of its two ends from the
    infinite line of the longer one, is below `merge_distance_px`, and at least `merge_overlap` of
    it faces the longer one.
    """
    order = np.argsort(-_lengths(segments_px), kind="stable")
    segments_px, polarity = segments_px[order], polarity[order]
    kept = detect_kernels.keep_first(
        segments_px, polarity, config.merge_distance_px, config.merge_overlap
    )
    return Seeds(segments_px=segments_px[kept], polarity=polarity[kept])


def _lengths(segments_px: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(segments_px[:, 1] - segments_px[:, 0], axis=1))
