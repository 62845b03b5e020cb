"""Writes the golden files: run by hand when a new minor version of a format is released.

    python tests/golden/make.py

A released file is never written anew; its test decodes it for ever.
"""

import json
from pathlib import Path

import numpy as np

from roel_service.scene.lines import LineMap
from roel_service.wire.provenance import Provenance
from roel_service.wire.rlm import decode_map, encode_map

HERE = Path(__file__).resolve().parent


def golden_map():
    """Lines of many lengths, with known and unknown quality, one of them too short to keep."""
    rng = np.random.default_rng(0)
    count = 60
    start = rng.uniform(-4.0, 4.0, (count, 3)).round(3)
    offset = rng.normal(0.0, 0.4, (count, 3)).round(3)
    offset[7] = 0.0002
    return LineMap(
        segments=np.stack([start, start + offset], axis=1),
        observation_count=rng.integers(0, 70_000, count),
        rms_residual_px=rng.choice([0.0, 0.01, 0.25, 2.0, 1e4], count),
        sigma_m=rng.choice([0.0, 1e-4, 0.003, 0.1, 50.0], count),
    )


def golden_provenance():
    return Provenance(
        config_digest="sha256:c0ffee",
        code_version="0.1.0",
        events_sha256="e" * 64,
        poses_sha256="b" * 64,
        camera_sha256="a" * 64,
    )


def expectation(data):
    """What a decoder of any later version has to find in a file."""
    map_file = decode_map(data)
    line_map = map_file.line_map
    return {
        "format_version": list(map_file.format_version),
        "frame_id": map_file.frame_id,
        "config_digest": map_file.provenance.config_digest,
        "dropped_line_count": map_file.dropped_line_count,
        "digest": map_file.digest,
        "segments": line_map.segments.round(6).tolist(),
        "observation_count": line_map.observation_count.tolist(),
        "rms_residual_px": line_map.rms_residual_px.tolist(),
        "sigma_m": line_map.sigma_m.tolist(),
    }


def main():
    data = encode_map(golden_map(), golden_provenance())
    (HERE / "map_1_0.rlm").write_bytes(data)
    (HERE / "map_1_0.json").write_text(json.dumps(expectation(data)) + "\n")


if __name__ == "__main__":
    main()
