"""The cameras of a problem, as LIMAP has them."""

from __future__ import annotations

from typing import Any

import pycolmap

CAMERA_ID, FIRST_IMAGE_ID = 1, 1


def posed_images(problem: dict[str, Any]) -> pycolmap.Reconstruction:
    """A COLMAP model of one pinhole camera and its poses, without points."""
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=CAMERA_ID,
        model="PINHOLE",
        width=int(problem["width"]),
        height=int(problem["height"]),
        params=problem["pinhole_px"],
    )
    reconstruction.add_camera_with_trivial_rig(camera)
    poses = zip(problem["R_camera_world"], problem["t_camera_world"], strict=True)
    for image_id, (rotation, translation) in enumerate(poses, start=FIRST_IMAGE_ID):
        image = pycolmap.Image(name=f"{image_id}.png", camera_id=CAMERA_ID, image_id=image_id)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
        reconstruction.add_image_with_trivial_frame(image, pose)
    return reconstruction
