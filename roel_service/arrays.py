"""Array aliases and the one gate through which arrays enter the domain types."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

Array = NDArray[Any]
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def frozen_array(
    values: ArrayLike, dtype: DTypeLike, shape: tuple[int | None, ...], name: str
) -> Array:
    """Return `values` as a C-contiguous, finite, read-only array of one dtype and shape.

    Args:
        values: anything array-like; an array that already fits is shared, not copied.
        dtype: exact dtype of the result; integers must hold the values exactly.
        shape: expected shape, None where any size is allowed.
        name: what the caller calls the array, for the error message.

    Raises:
        ValueError: if the shape does not match, a value is not finite, or an integer does not fit.
    """
    given = np.asarray(values)
    with np.errstate(over="ignore", invalid="ignore"):  # the checks below say it better
        array = np.ascontiguousarray(given, dtype=dtype)
    fits = array.ndim == len(shape) and all(
        expected is None or expected == found
        for expected, found in zip(shape, array.shape, strict=True)
    )
    if not fits:
        pattern = tuple("*" if size is None else size for size in shape)
        raise ValueError(f"{name}: expected shape {pattern}, found {array.shape}")
    floats = array if array.dtype.kind == "f" else given
    if floats.dtype.kind == "f" and not np.isfinite(floats).all():
        raise ValueError(f"{name}: expected finite values, found NaN or infinity")
    # A cast to integers wraps and truncates in silence: 65536 + 5 would become pixel 5.
    if array.dtype.kind in "iu" and array.dtype != given.dtype and (array != given).any():
        raise ValueError(f"{name}: expected values that fit {array.dtype}")
    view = array.view()
    view.flags.writeable = False
    return view
