"""What a perfect map would hold: edges that can be seen, and the surfaces as points."""

from __future__ import annotations

import cv2
import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.geometry import projection
from roel_service.geometry.se3 import SE3
from roel_service.geometry.segments import point_segment_distance
from roel_service.in_order import in_order
from roel_service.progress import StepCallback
from roel_service.simulate.panoramas import FACE_ROTATIONS
from roel_service.simulate.render import THREAD_COUNT, render, render_depth
from roel_service.simulate.scenes import Scene, TextureAtlas

# Voxels of edge points, and how many views must agree on one.
EDGE_VOXEL_M = 0.005
# An edge point this close to a rim is of it: the voxel, and a pixel of the views.
RIM_DISTANCE_M = 0.01
MIN_VIEW_COUNT = 2
# Views for the edges have this many times the sensor's resolution.
EDGE_ZOOM = 2
# Canny thresholds, in grey values of a picture with gamma.
CANNY_LOW, CANNY_HIGH = 30, 70
# The cloud: noise, voxel, and size of the views.
CLOUD_NOISE_M = 0.005
CLOUD_VOXEL_M = 0.02
CLOUD_VIEW_PX = 320
# A voxel's three indices in one integer: a million voxels to either side of the origin.
KEY_BITS = 21
KEY_OFFSET = 1 << (KEY_BITS - 1)


def observable_edges(
    scene: Scene,
    atlas: TextureAtlas,
    T_world_camera: SE3,
    K: FloatArray,
    width: int,
    height: int,
    scale: float,
    progress: StepCallback,
) -> Array:
    """(M, 3) float32 m: edges of rendered views, lifted by their depth, seen at least twice.

    Args:
        scene, atlas: surfaces and their brightness.
        T_world_camera: (N) views.
        K, width, height: of the sensor.
        scale: of the voxels, in units of a room.
        progress: called for every view.
    """
    voxel_m = EDGE_VOXEL_M * scale
    zoomed = K * EDGE_ZOOM
    # Pixel centres are at integers: the corner of the image, at -1/2, is what stays in place.
    zoomed[:2, 2] += 0.5 * (EDGE_ZOOM - 1)
    zoomed[2, 2] = 1.0

    def keys_of_view(view: int) -> IntArray:
        points = _edge_points(scene, atlas, T_world_camera[view], zoomed, width, height)
        return np.unique(_voxel_keys(points, voxel_m))

    view_count = len(T_world_camera)
    seen: list[IntArray] = []
    for keys in in_order(keys_of_view, range(view_count), THREAD_COUNT):
        progress(len(seen), view_count)
        seen.append(keys)
    keys, counts = np.unique(np.concatenate(seen), return_counts=True)
    return np.asarray(_voxel_middles(keys[counts >= MIN_VIEW_COUNT], voxel_m), dtype=np.float32)


def _edge_points(
    scene: Scene, atlas: TextureAtlas, T_world_camera: SE3, K: FloatArray, width: int, height: int
) -> FloatArray:
    """(n, 3) m, world, of the Canny edges of one view."""
    size = (width * EDGE_ZOOM, height * EDGE_ZOOM)
    picture = render(scene, atlas, T_world_camera, K, *size)[..., 0]
    grey = np.rint(255.0 * picture.clip(0, 1) ** (1 / 2.2)).astype(np.uint8)
    depth_m = render_depth(scene, T_world_camera, K, *size)
    # An edge belongs to the nearer of the surfaces that meet in it. By default OpenCV takes the
    # largest finite number for the depth beyond the border, nearer than infinity.
    nearest_m = cv2.erode(depth_m, np.ones((3, 3)), borderType=cv2.BORDER_REPLICATE)
    rows, columns = np.nonzero(cv2.Canny(grey, CANNY_LOW, CANNY_HIGH))
    hit = np.isfinite(nearest_m[rows, columns])
    return _lifted(rows[hit], columns[hit], np.asarray(nearest_m), K, T_world_camera)


def edges_along(rims: tuple[FloatArray, ...], edges: Array, scale: float) -> Array:
    """The (k, 3) edge points beside one of the rims.

    Args:
        rims: (n, 3) m each, chains of points.
        edges: (M, 3) m.
        scale: of the distance, in units of a room.
    """
    nearest_m = np.full(len(edges), np.inf)
    for rim in rims:
        for piece in np.stack([rim[:-1], rim[1:]], axis=1):
            np.minimum(nearest_m, point_segment_distance(edges, piece), out=nearest_m)
    return edges[nearest_m < RIM_DISTANCE_M * scale]


def surface_cloud(
    scene: Scene, places: FloatArray, scale: float, rng: np.random.Generator
) -> Array:
    """(N, 3) float32 m: surfaces as a depth camera would see them; one noisy point a voxel.

    Args:
        scene: surfaces.
        places: (P, 3) m, from which all directions are looked at.
        scale: of noise and voxels, in units of a room.
        rng: draws the noise.
    """
    voxel_m = CLOUD_VOXEL_M * scale

    def points_seen_from(place: FloatArray) -> FloatArray:
        return _first_of_voxels(_surface_points(scene, place), voxel_m)

    seen = in_order(points_seen_from, places, THREAD_COUNT)
    cloud = _first_of_voxels(np.concatenate(list(seen)), voxel_m)
    noise = rng.normal(scale=CLOUD_NOISE_M * scale, size=cloud.shape)
    return np.asarray(cloud + noise, dtype=np.float32)


def _surface_points(scene: Scene, place: FloatArray) -> FloatArray:
    """(n, 3) m: what can be seen from a place, in all directions."""
    middle = (CLOUD_VIEW_PX - 1) / 2
    half = CLOUD_VIEW_PX / 2
    K = np.array([[half, 0, middle], [0, half, middle], [0, 0, 1.0]])
    points = []
    for R_world_camera in FACE_ROTATIONS:
        T_world_camera = SE3(rotation=R_world_camera, translation=place)
        depth_m = render_depth(scene, T_world_camera, K, CLOUD_VIEW_PX, CLOUD_VIEW_PX)
        rows, columns = np.nonzero(np.isfinite(depth_m))
        points.append(_lifted(rows, columns, depth_m, K, T_world_camera))
    return np.concatenate(points)


def _lifted(
    rows: Array, columns: Array, depth_m: FloatArray, K: FloatArray, T_world_camera: SE3
) -> FloatArray:
    """(n, 3) world points of pixels with a depth."""
    xy = projection.normalized_from_pixel(np.stack([columns, rows], axis=-1), K)
    in_camera = np.column_stack([xy, np.ones(len(xy))]) * depth_m[rows, columns, None]
    return T_world_camera @ in_camera


def _first_of_voxels(points: FloatArray, voxel_m: float) -> FloatArray:
    """(m, 3) the first point of each voxel, in order."""
    first = np.unique(_voxel_keys(points, voxel_m), return_index=True)[1]
    return points[np.sort(first)]


def _voxel_keys(points: FloatArray, voxel_m: float) -> IntArray:
    """(n,) one number for each point's voxel: rows of three would sort five times slower."""
    x, y, z = (np.floor(points / voxel_m).astype(np.int64) + KEY_OFFSET).T
    return np.asarray((x << 2 * KEY_BITS) | (y << KEY_BITS) | z)


def _voxel_middles(keys: IntArray, voxel_m: float) -> FloatArray:
    """(n, 3) m."""
    indices = np.stack([keys >> 2 * KEY_BITS, keys >> KEY_BITS, keys], axis=-1)
    indices &= (1 << KEY_BITS) - 1
    return np.asarray((indices - KEY_OFFSET + 0.5) * voxel_m)
