"""Figures that the paper prints, to stand beside ours.

RoEL: Robust Event-based 3D Line Reconstruction (Bae et al., IEEE T-RO 2026). Its scenes are
Replica's at 1200 x 680 with events by VID2E and edges by PiDiNet, so that figures compare in order
of magnitude alone; what carries over is which rows are better than which.
"""

from __future__ import annotations

from dataclasses import dataclass

# Table "Runtime analysis": seconds a frame on office4, Ryzen 9 3900X and GeForce RTX 3090.
SECONDS_PER_FRAME = {
    "detect": 0.064,
    "plane_fit": 0.358,
    "match_local": 0.001,
    "match_global": 0.663,
    "triangulate": 0.120,
    "refine": 0.351,
}


@dataclass(frozen=True, kw_only=True)
class MapRow:
    """Accuracy and completion in mm, IoU at 5, 10 and 20 mm, number of lines or points."""

    accuracy_mm: float
    completion_mm: float
    iou_5: float | None = None
    iou_10: float | None = None
    iou_20: float
    entity_count: int | None = None


# Table "Quantitative comparison of reconstruction quality on the Replica dataset", rows "avg".
REPLICA = {
    "EL-SLAM": MapRow(
        accuracy_mm=248.92,
        completion_mm=153.47,
        iou_5=0.006,
        iou_10=0.021,
        iou_20=0.063,
        entity_count=1169,
    ),
    "LIMAP": MapRow(
        accuracy_mm=536.79,
        completion_mm=113.47,
        iou_5=0.006,
        iou_10=0.024,
        iou_20=0.073,
        entity_count=2136,
    ),
    "EMVS": MapRow(
        accuracy_mm=181.24,
        completion_mm=45.68,
        iou_5=0.009,
        iou_10=0.027,
        iou_20=0.062,
        entity_count=884_709,
    ),
    "RoEL": MapRow(
        accuracy_mm=28.20,
        completion_mm=99.04,
        iou_5=0.020,
        iou_10=0.055,
        iou_20=0.137,
        entity_count=2494,
    ),
}

# Table "Ablation study", office4.
ABLATION = {
    "single window and representation": MapRow(
        accuracy_mm=65.98, completion_mm=104.93, iou_20=0.068
    ),
    "all windows and representations": MapRow(accuracy_mm=68.00, completion_mm=51.17, iou_20=0.053),
    "and plane fitting": MapRow(accuracy_mm=47.94, completion_mm=44.09, iou_20=0.089),
    "and refinement, LIMAP's cost": MapRow(accuracy_mm=46.57, completion_mm=58.36, iou_20=0.092),
    "and refinement, line cost": MapRow(accuracy_mm=39.81, completion_mm=58.82, iou_20=0.097),
    "and refinement, line and event cost": MapRow(
        accuracy_mm=28.63, completion_mm=55.20, iou_20=0.120
    ),
}


@dataclass(frozen=True, kw_only=True)
class FrameRow:
    """Lines a frame, precision, recall and F-score against projected edges."""

    f_score: float
    precision: float | None = None
    recall: float | None = None
    line_count: int | None = None


# Tables "Quantitative analysis on plane fitting strategies", "... across stages of multi-window,
# multi-representation line detection", "Sensitivity analysis" and "Comparison of velocity-invariant
# representations", all on office4.
PLANE_FITTING = {
    "direct": FrameRow(precision=0.603, recall=0.228, f_score=0.331),
    "detection-guided": FrameRow(precision=0.535, recall=0.526, f_score=0.530),
}
DETECTION = {
    "single prediction": FrameRow(line_count=31, precision=0.612, recall=0.344, f_score=0.434),
    "all, not merged": FrameRow(line_count=185, precision=0.359, recall=0.758, f_score=0.487),
    "all, merged": FrameRow(line_count=55, precision=0.530, recall=0.523, f_score=0.526),
}
WINDOW_SIZES = {
    "x 1/10": FrameRow(f_score=0.368),
    "x 1/5": FrameRow(f_score=0.523),
    "x 1": FrameRow(f_score=0.526),
    "x 5": FrameRow(f_score=0.484),
    "x 10": FrameRow(f_score=0.443),
}
REPRESENTATIONS = {
    "binary + TOS": FrameRow(f_score=0.502),
    "timestamp + TOS": FrameRow(f_score=0.523),
    "binary + timestamp": FrameRow(f_score=0.526),
    "binary + SITS": FrameRow(f_score=0.499),
    "timestamp + SITS": FrameRow(f_score=0.496),
}
VELOCITY_INVARIANT = {
    "TOS": FrameRow(line_count=42, precision=0.527, recall=0.380, f_score=0.441),
    "SITS": FrameRow(line_count=62, precision=0.443, recall=0.412, f_score=0.427),
    "binary + timestamp": FrameRow(line_count=55, precision=0.530, recall=0.523, f_score=0.526),
}
