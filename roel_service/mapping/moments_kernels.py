"""Loop over the supporting events of every observation."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array


@numba.njit(cache=True, nogil=True)
def accumulate(
    frame: Array,
    event_offsets: Array,
    event_normalized: Array,
    event_dt_us: Array,
    R_frame_slot: Array,
    centre_frame: Array,
    reach_us: int,
    slot_us: int,
    event_count: int,
    forms: Array,
) -> None:
    """Write the mean of a a^T, a = (o x u, u), over the events of each observation.

    Args:
        frame: (M,) frame of each observation.
        event_offsets: (M + 1,) ranges of events.
        event_normalized: (P, 2) ideal image coordinates at depth 1.
        event_dt_us: (P,) time against the frame, |dt| < reach_us.
        R_frame_slot: (N, S, 3, 3) rotations of the camera at each slot, in the frame's camera.
        centre_frame: (N, S, 3) its centres there, m.
        slot_us: length of a slot; the first starts at -reach_us.
        event_count: events used of each observation; 0 uses all.
        forms: (M, 6, 6) written; zero without events.
    """
    a = np.empty(6)
    for m in range(len(frame)):
        first, last = event_offsets[m], event_offsets[m + 1]
        if event_count > 0:
            last = min(last, first + event_count)
        for k in range(first, last):
            slot = (event_dt_us[k] + reach_us) // slot_us
            R = R_frame_slot[frame[m], slot]
            o = centre_frame[frame[m], slot]
            x, y = event_normalized[k, 0], event_normalized[k, 1]
            scale = 1.0 / np.sqrt(x * x + y * y + 1.0)
            for row in range(3):
                a[3 + row] = (R[row, 0] * x + R[row, 1] * y + R[row, 2]) * scale
            a[0] = o[1] * a[5] - o[2] * a[4]
            a[1] = o[2] * a[3] - o[0] * a[5]
            a[2] = o[0] * a[4] - o[1] * a[3]
            for row in range(6):
                for column in range(6):
                    forms[m, row, column] += a[row] * a[column]
        if last > first:
            forms[m] /= last - first
