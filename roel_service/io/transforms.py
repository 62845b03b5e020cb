"""Rigid transforms as text: four lines of four numbers, `#` comments."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from roel_service.errors import InputError
from roel_service.geometry.se3 import SE3
from roel_service.io.files import read_input
from roel_service.io.text import parse_rows

# A rotation this far off orthogonal is rounded text; farther off, it is something else.
MAX_ROTATION_ERROR = 1e-3
_MAX_BYTES = 1 << 16


def read_transform(path: Path) -> SE3:
    """Read a 4x4 matrix; its rotation is made exact.

    Raises:
        InputError: no readable file, not four rows of four numbers, a last row that is not
            0 0 0 1, or no rotation within `MAX_ROTATION_ERROR`.
    """
    subject = str(path)
    rows = parse_rows(read_input(path, _MAX_BYTES), "m1 m2 m3 m4", 1, subject, InputError)
    if rows.shape != (4, 4):
        raise InputError(subject, "four lines of four numbers", f"{len(rows)} lines")
    if np.abs(rows[3] - [0.0, 0.0, 0.0, 1.0]).max() > MAX_ROTATION_ERROR:
        raise InputError(subject, "a last row of 0 0 0 1", f"{rows[3].tolist()}")
    left, _, right = np.linalg.svd(rows[:3, :3])
    rotation = left @ right
    error = float(np.abs(rotation - rows[:3, :3]).max())
    if error > MAX_ROTATION_ERROR or np.linalg.det(rotation) < 0.0:
        found = f"a matrix {error:.2g} off one, or a reflection"
        raise InputError(subject, f"a rotation within {MAX_ROTATION_ERROR:g}", found)
    return SE3(rotation=rotation, translation=rows[:3, 3])
