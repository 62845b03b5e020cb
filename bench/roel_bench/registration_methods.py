"""Ways to register a map with a cloud, ours and others', behind one signature.

Others get points along the lines for a source, and the same thinned cloud for a target: Open3D's ICP from
coarse to fine, its searches by FPFH features, and small_gicp where it is installed (extra `bench`).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import RegisterConfig
from roel_service.geometry.se3 import SE3
from roel_service.geometry.segments import sample_segments
from roel_service.register.prepare import PreparedCloud
from roel_service.register.register import register_map
from roel_service.scene.lines import LineMap
from roel_service.scene.results import RegistrationResult

# Points of the others are so far apart; the paper's 5 mm are 16 times as many as the cloud has room for.
SPACING_M = 0.02
# Gates of ICP from coarse to fine, and iterations of each.
GATES_M, ITERATION_COUNT = (0.5, 0.15, 0.05), 40
# Scale of the robust loss against the gate.
LOSS_SHARE = 0.5
# Features are of points so far apart, over neighbours within so many of these.
FEATURE_VOXEL_M, NORMAL_REACH, FEATURE_REACH, FEATURE_GATE = 0.08, 2.0, 5.0, 1.5
NEIGHBOUR_COUNT = 30
RANSAC_COUNT, RANSAC_CONFIDENCE = 100_000, 0.999
SMALL_GICP = "small_gicp"


@dataclass(frozen=True, eq=False, kw_only=True)
class Target:
    """A cloud, prepared for us, and for others when they first ask."""

    cloud: PreparedCloud

    @cached_property
    def of_open3d(self) -> Any:
        """The thinned points with Open3D's normals and covariances."""
        open3d = _open3d()
        cloud = _open3d_cloud(self.cloud.points)
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBOUR_COUNT))
        cloud.estimate_covariances(open3d.geometry.KDTreeSearchParamKNN(NEIGHBOUR_COUNT))
        return cloud


@dataclass(frozen=True, eq=False, kw_only=True)
class Query:
    """What is asked: a map, a cloud, and a first guess or none.

    Attributes:
        config: with the spacing of points, and whether both sides know the vertical.
    """

    line_map: LineMap
    target: Target
    T_init: SE3 | None
    config: RegisterConfig


@dataclass(frozen=True, eq=False, kw_only=True)
class Answer:
    """Where the map lies; with a verdict and more, where the method tells them."""

    T_target_source: SE3
    result: RegistrationResult | None = None


Method = Callable[[Query], Answer]


def _ours(method: str) -> Method:
    def register(query: Query) -> Answer:
        result = register_map(
            query.line_map, query.target.cloud, query.config, method=method, T_init=query.T_init
        )
        return Answer(T_target_source=result.T_target_source, result=result)

    return register


def _open3d_icp(kind: str) -> Method:
    def register(query: Query) -> Answer:
        registration = _open3d().pipelines.registration
        source = _open3d_cloud(_points(query))
        target = query.target.of_open3d
        T = (query.T_init or SE3.identity()).matrix()
        for gate_m in GATES_M:
            loss = registration.GMLoss(LOSS_SHARE * gate_m)
            criteria = registration.ICPConvergenceCriteria(max_iteration=ITERATION_COUNT)
            if kind == "plane":
                estimation = registration.TransformationEstimationPointToPlane(loss)
                found = registration.registration_icp(
                    source, target, gate_m, T, estimation, criteria
                )
            else:
                estimation = registration.TransformationEstimationForGeneralizedICP()
                found = registration.registration_generalized_icp(
                    source, target, gate_m, T, estimation, criteria
                )
            T = found.transformation
        return Answer(T_target_source=_rigid(T))

    return register


def _open3d_features(kind: str) -> Method:
    def register(query: Query) -> Answer:
        registration = _open3d().pipelines.registration
        source = _open3d_cloud(_points(query)).voxel_down_sample(FEATURE_VOXEL_M)
        target = _open3d_cloud(query.target.cloud.points).voxel_down_sample(FEATURE_VOXEL_M)
        features = [_features(cloud) for cloud in (source, target)]
        gate_m = FEATURE_GATE * FEATURE_VOXEL_M
        if kind == "ransac":
            _open3d().utility.random.seed(0)
            found = registration.registration_ransac_based_on_feature_matching(
                source,
                target,
                *features,
                True,
                gate_m,
                registration.TransformationEstimationPointToPoint(False),
                3,
                [
                    registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                    registration.CorrespondenceCheckerBasedOnDistance(gate_m),
                ],
                registration.RANSACConvergenceCriteria(RANSAC_COUNT, RANSAC_CONFIDENCE),
            )
        else:
            option = registration.FastGlobalRegistrationOption(
                maximum_correspondence_distance=gate_m
            )
            found = registration.registration_fgr_based_on_feature_matching(
                source, target, *features, option
            )
        return _open3d_icp("plane")(replace(query, T_init=_rigid(found.transformation)))

    return register


def _small_gicp(query: Query) -> Answer:
    import small_gicp

    T = (query.T_init or SE3.identity()).matrix()
    for gate_m in GATES_M:
        found = small_gicp.align(
            query.target.cloud.points,
            _points(query),
            init_T_target_source=T,
            registration_type="GICP",
            downsampling_resolution=SPACING_M,
            max_correspondence_distance=gate_m,
            max_iterations=ITERATION_COUNT,
            num_threads=1,
        )
        T = found.T_target_source
    return Answer(T_target_source=_rigid(T))


METHODS: dict[str, Method] = {
    "auto": _ours("auto"),
    "point": _ours("point"),
    "plane": _ours("plane"),
    "line": _ours("line"),
    "global": _ours("global"),
    "open3d plane": _open3d_icp("plane"),
    "open3d gicp": _open3d_icp("gicp"),
    "open3d fpfh ransac": _open3d_features("ransac"),
    "open3d fpfh fgr": _open3d_features("fgr"),
    "small_gicp": _small_gicp,
}


def is_available(method: str) -> bool:
    """Whether what a method needs is installed."""
    return method != SMALL_GICP or importlib.util.find_spec(SMALL_GICP) is not None


def _points(query: Query) -> FloatArray:
    """(P, 3) points along the lines, m."""
    return sample_segments(query.line_map.segments, SPACING_M)[0]


def _open3d() -> Any:
    """Open3D, loaded when it is needed; untyped, since its stubs lack what it overloads."""
    import open3d

    return open3d


def _open3d_cloud(points: FloatArray) -> Any:
    open3d = _open3d()
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))


def _features(cloud: Any) -> Any:
    open3d = _open3d()

    def neighbours(reach: float) -> Any:
        return open3d.geometry.KDTreeSearchParamHybrid(
            radius=reach * FEATURE_VOXEL_M, max_nn=NEIGHBOUR_COUNT
        )

    cloud.estimate_normals(neighbours(NORMAL_REACH))
    return open3d.pipelines.registration.compute_fpfh_feature(cloud, neighbours(FEATURE_REACH))


def _rigid(T: FloatArray) -> SE3:
    """The nearest rotation: products of many drift."""
    left, _, right = np.linalg.svd(np.asarray(T)[:3, :3])
    return SE3(rotation=left @ right, translation=np.asarray(T)[:3, 3])
