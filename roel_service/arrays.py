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
        dtype: exact dtype of the result.
        shape: expected shape, None where any size is allowed.
        name: what the caller calls the array, for the error message.

    Raises:
        ValueError: if the shape does not match or a value is not finite.
    """
    array = np.ascontiguousarray(values, dtype=dtype)
    fits = array.ndim == len(shape) and all(
        expected is None or expected == found
        for expected, found in zip(shape, array.shape, strict=True)
    )
    if not fits:
        pattern = tuple("*" if size is None else size for size in shape)
        raise ValueError(f"{name}: expected shape {pattern}, found {array.shape}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite values, found NaN or infinity")
    view = array.view()
    view.flags.writeable = False
    return view
