"""Meshes and points: NPZ and PLY, told apart by content."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from roel_service.arrays import Array
from roel_service.errors import CloudError, InputError, MeshError
from roel_service.io.files import open_input
from roel_service.io.npz import read_npz, write_npz
from roel_service.io.ply import read_ply
from roel_service.scene.clouds import PointCloud, TriangleMesh

__all__ = ["read_mesh", "read_points", "write_npz"]

_log = logging.getLogger(__name__)


def read_mesh(path: Path) -> TriangleMesh:
    """Read triangles: NPZ with `triangles` (N, 3, 3), or PLY with faces; m.

    Raises:
        InputError: no readable file.
        MeshError: neither format, no triangles, or a corner that is not finite.
    """
    subject = str(path)
    if _is_ply(path):
        ply = read_ply(path, MeshError)
        if ply.faces is None:
            raise MeshError(subject, "faces", "none")
        triangles = _float32(ply.vertices)[ply.faces]
    else:
        triangles = _npz_array(path, "triangles", (3, 3), MeshError)
    if len(triangles) == 0:
        raise MeshError(subject, "at least one triangle", "none")
    if not np.isfinite(triangles).all():
        raise MeshError(subject, "finite corners", "NaN or infinity")
    return TriangleMesh(triangles=triangles)


def read_points(path: Path, key: str, min_count: int = 1) -> PointCloud:
    """Read points, leaving out those that are not finite with one warning.

    Args:
        path: NPZ with `key` (N, 3), m, and optional `normals`; or PLY vertices.
        key: name of the array, `points` or `edges`.
        min_count: fewer finite points than this are unusable.

    Raises:
        InputError: no readable file.
        CloudError: neither format, or fewer than `min_count` finite points.
    """
    subject = str(path)
    normals: Array | None
    if _is_ply(path):
        ply = read_ply(path, CloudError)
        points, normals = _float32(ply.vertices), ply.normals
    else:
        points = _npz_array(path, key, (3,), CloudError)
        normals = read_npz(path, ("normals",), subject, CloudError).get("normals")
    if normals is not None and (normals.shape != points.shape or normals.dtype.kind not in "iuf"):
        raise CloudError(subject, f"normals of shape {points.shape}", f"{normals.shape}")
    finite = np.isfinite(points).all(axis=1)
    if normals is not None:
        normals = _float32(normals)
        finite &= np.isfinite(normals).all(axis=1)
        normals = normals[finite]
    if not finite.all():
        _log.warning("%s: left out %d points that are not finite", subject, (~finite).sum())
    if finite.sum() < min_count:
        raise CloudError(subject, f"at least {min_count} finite points", f"{finite.sum()}")
    return PointCloud(points=points[finite], normals=normals)


def _is_ply(path: Path) -> bool:
    with open_input(path) as file:
        return file.read(3) == b"ply"


def _npz_array(path: Path, key: str, row: tuple[int, ...], error: type[InputError]) -> Array:
    """(N, *row) float32 array of an archive."""
    subject = str(path)
    arrays = read_npz(path, (key,), subject, error)
    if key not in arrays:
        raise error(subject, f"an array {key}", "none")
    array = arrays[key]
    if array.shape[1:] != row or array.ndim == 0 or array.dtype.kind not in "iuf":
        shape = ", ".join(["N", *(str(size) for size in row)])
        raise error(subject, f"{key} of shape ({shape})", f"{array.shape} of {array.dtype}")
    return _float32(array)


def _float32(values: Array) -> Array:
    """As float32; what it cannot hold becomes infinite and is refused or left out later."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)
