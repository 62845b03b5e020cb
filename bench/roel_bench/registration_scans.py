"""Scans of the real world, registered as point sets through the same core.

Sources: the test pair of small_gicp; `room_scan1` and `room_scan2` of PCL's tutorials, of which the heading
alone is known (40.8 degrees), with the first guess of the tutorial on NDT; the car scans and the first
two clouds of libpointmatcher, whose tests allow 0.1 rad and 0.1 m, and 5 % of the size of coordinates.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from roel_bench.registration import Trial, errors
from roel_service.arrays import FloatArray
from roel_service.config.stages import RegisterConfig
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.io.clouds import read_cloud
from roel_service.io.transforms import read_transform
from roel_service.register.prepare import prepare_cloud
from roel_service.register.register import register_map

SCAN = "scan"

PCL_YAW_DEG = 40.8
PCL_GUESS = SE3(
    rotation=rotation_from_vector(np.array([0.0, 0.0, 0.6931])),
    translation=np.array([1.79387, 0.720047, 0.0]),
)


def _orthonormal(matrix: FloatArray) -> FloatArray:
    """A published matrix of few digits with its rotation made exact."""
    left, _, right = np.linalg.svd(matrix[:3, :3])
    exact = matrix.copy()
    exact[:3, :3] = left @ right
    return exact


# What libpointmatcher's tests compare with: by eye (its car scans), and by its own ICP (its first two clouds).
CAR = _orthonormal(
    np.array(
        [
            [0.982304, 0.166685, -0.0854066, 0.0446816],
            [-0.150189, 0.973488, 0.172524, 0.191998],
            [0.111899, -0.156644, 0.981296, -0.0356313],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
)
CLOUDS = _orthonormal(
    np.array(
        [
            [0.979842, -0.162013, 0.116882, -0.172018],
            [0.179165, 0.971470, -0.155388, -0.208090],
            [-0.088372, 0.173197, 0.980914, -0.167270],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Pair:
    """Two scans, and what is known of the transform between them.

    Attributes:
        source, target: file names.
        voxel_m: of the thinned clouds.
        true: T_target_source by the folder of scans.
        has_shift: whether more than the heading is known.
        method, T_init: as asked.
    """

    name: str
    source: str
    target: str
    voxel_m: float
    true: Callable[[Path], SE3]
    has_shift: bool = True
    method: str = "auto"
    T_init: SE3 | None = None


def _pcl_heading(_: Path) -> SE3:
    turn = np.array([0.0, 0.0, np.radians(PCL_YAW_DEG)])
    return SE3(rotation=rotation_from_vector(turn), translation=np.zeros(3))


_ROOMS = Pair(
    name="PCL rooms, from nothing",
    source="room_scan2.pcd",
    target="room_scan1.pcd",
    voxel_m=0.06,
    true=_pcl_heading,
    has_shift=False,
    method="global",
)
PAIRS = (
    Pair(
        name="small_gicp's pair",
        source="source.ply",
        target="target.ply",
        voxel_m=0.25,
        true=lambda folder: read_transform(folder / "T_target_source.txt"),
    ),
    _ROOMS,
    replace(_ROOMS, name="PCL rooms, from the tutorial's guess", method="auto", T_init=PCL_GUESS),
    Pair(
        name="libpointmatcher's car scans",
        source="car_cloud401.csv",
        target="car_cloud400.csv",
        voxel_m=0.05,
        true=lambda _: SE3.from_matrix(CAR),
    ),
    Pair(
        name="libpointmatcher's clouds 1 and 0",
        source="cloud.00001.vtk",
        target="cloud.00000.vtk",
        voxel_m=0.05,
        true=lambda _: SE3.from_matrix(CLOUDS),
    ),
)


def run(folder: Path) -> list[Trial]:
    """One trial for each pair.

    Raises:
        InputError: a scan that cannot be read.
    """
    return [_trial(pair, folder) for pair in PAIRS]


def _trial(pair: Pair, folder: Path) -> Trial:
    config = RegisterConfig(
        voxel_m=pair.voxel_m,
        last_scale_m=pair.voxel_m / 2,
        max_distance_m=2.5 * pair.voxel_m,
    )
    clouds = [read_cloud(folder / name) for name in (pair.source, pair.target)]
    began_s = time.process_time()
    source, target = (prepare_cloud(cloud, config) for cloud in clouds)
    prepared_s = time.process_time()
    result = register_map(source, target, config, method=pair.method, T_init=pair.T_init)
    seconds = time.process_time() - prepared_s
    T, true = result.T_target_source, pair.true(folder)
    degrees, _ = errors(T, true)
    if not pair.has_shift:
        yaw_deg = np.degrees(np.arctan2(T.rotation[1, 0], T.rotation[0, 0]))
        degrees = float(abs(yaw_deg - PCL_YAW_DEG))
    # Shifts are compared where they are told, not carried to the origin of the target.
    shift_mm = 1e3 * float(np.linalg.norm(T.translation - true.translation))
    return Trial(
        place=pair.name,
        kind=SCAN,
        line_count=0,
        point_count=len(target.points),
        is_tuning=True,
        protocol=SCAN,
        method=pair.method,
        seed=0,
        rotation_deg=round(degrees, 5),
        translation_mm=round(shift_mm, 4) if pair.has_shift else None,
        verdict=result.verdict.value,
        is_listed=True,
        nees=None,
        seconds=round(seconds, 4),
        prepare_seconds=round(prepared_s - began_s, 3),
    )
