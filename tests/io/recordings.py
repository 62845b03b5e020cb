"""Recordings written without the code under test, and the streams they hold."""

import h5py
import numpy as np

from roel_service.scene.events import EventStream

WIDTH, HEIGHT = 20, 10


def columns(count, seed=0, start_us=0, step_us=700):
    """Valid raw columns t, x, y, p (0 or 1)."""
    rng = np.random.default_rng(seed)
    return {
        "t": start_us + np.cumsum(rng.integers(0, step_us, count)),
        "x": rng.integers(0, WIDTH, count),
        "y": rng.integers(0, HEIGHT, count),
        "p": rng.integers(0, 2, count),
    }


def stream(raw, t_offset_us=0):
    return EventStream(
        t_us=raw["t"] + t_offset_us,
        x=raw["x"],
        y=raw["y"],
        polarity=np.where(raw["p"] == 1, 1, -1),
        width=WIDTH,
        height=HEIGHT,
    )


def write_hdf5(path, raw, t_offset=None, **storage):
    with h5py.File(path, "w") as file:
        for name, values in raw.items():
            file.create_dataset(f"events/{name}", data=values, **storage)
        if t_offset is not None:
            file["t_offset"] = t_offset


def write_npz(path, raw, **others):
    np.savez_compressed(path, **raw, **others)


def write_text(path, raw, unit="s"):
    with open(path, "w") as file:
        file.write("# t x y p\n")
        for t, x, y, p in zip(*(raw[name].tolist() for name in "txyp"), strict=True):
            time = f"{t // 10**6}.{t % 10**6:06d}" if unit == "s" else t
            file.write(f"{time} {x} {y} {p}\n")


WRITERS = {"h5": write_hdf5, "npz": write_npz, "txt": write_text}


def assert_same_events(a, b):
    for name in ("t_us", "x", "y", "polarity"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert (a.width, a.height) == (b.width, b.height)
