"""The user's own textured mesh as a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from roel_service.arrays import Array, FloatArray
from roel_service.errors import MeshError
from roel_service.simulate.scenes import Scene, brightness_of

# glTF is y up; the simulator is z up.
R_Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
Y_UP_SUFFIXES = (".glb", ".gltf")
# A mesh without a picture is drawn in the mean colour of each face, from a table this wide.
PALETTE_WIDTH = 1024


def scene_from_mesh(path: Path) -> Scene:
    """Read a textured or coloured mesh (glb, obj, ply and what else trimesh reads).

    Raises:
        MeshError: not readable, or without triangles.
    """
    if not path.is_file():
        raise MeshError(str(path), "a mesh file", "no such file")
    try:
        # Unprocessed: merging corners would mix the colours that meet in them.
        loaded = trimesh.load_scene(path, process=False)
    except (ValueError, KeyError, IndexError, TypeError, OSError, NotImplementedError) as error:
        found = f"{type(error).__name__}: {error}"
        raise MeshError(str(path), "a mesh that trimesh reads", found) from error
    parts = [part for part in loaded.dump() if isinstance(part, trimesh.Trimesh)]
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        raise MeshError(str(path), "a mesh with triangles", "none")
    surfaces = [_surface(part) for part in parts]
    triangles = np.concatenate([part.triangles for part in parts]).astype(np.float64)
    if not np.isfinite(triangles).all():
        raise MeshError(str(path), "finite vertices", "NaN or infinity")
    if path.suffix.lower() in Y_UP_SUFFIXES:
        triangles = triangles @ R_Z_UP_FROM_Y_UP.T
    return Scene(
        triangles=triangles,
        uv=np.concatenate([uv for uv, _ in surfaces]),
        texture=np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts]),
        brightness=brightness_of(triangles),
        textures=tuple(image for _, image in surfaces),
    )


def _surface(part: trimesh.Trimesh) -> tuple[FloatArray, Array]:
    """(T, 3, 2) texture coordinates and (H, W, 3) texture of one part."""
    # trimesh's two kinds of visuals share no typed interface.
    visual: Any = part.visual
    if visual.kind == "texture":
        image = _picture(visual.material)
        if image is not None and visual.uv is not None:
            uv = np.asarray(visual.uv, dtype=np.float64)[part.faces]
            # trimesh counts v upwards.
            uv[..., 1] = 1.0 - uv[..., 1]
            return uv, image
        visual = visual.to_color()
    return _palette(_linear(np.asarray(visual.face_colors)[:, :3]), len(part.faces))


def _picture(material: Any) -> Array | None:
    """The texture of a material, of either kind that trimesh knows."""
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    return None if image is None else _linear(np.asarray(image.convert("RGB")))


def _palette(colours: Array, count: int) -> tuple[FloatArray, Array]:
    """A texture with one texel a face, and coordinates that stay in its middle."""
    width = min(PALETTE_WIDTH, count)
    height = -(-count // width)
    table = np.zeros((height * width, 3), np.float32)
    table[:count] = colours
    face = np.arange(count)
    middle = np.stack([(face % width + 0.5) / width, (face // width + 0.5) / height], axis=-1)
    return np.repeat(middle[:, None], 3, axis=1), table.reshape(height, width, 3)


def _linear(colours: Array) -> Array:
    """Linear intensity of 8-bit colours with gamma."""
    return np.asarray((colours.astype(np.float32) / 255.0) ** 2.2, dtype=np.float32)
