import dataclasses
import json

import numpy as np
import pytest

from roel_service.config.load import to_tables
from roel_service.config.presets import preset
from roel_service.config.stages import (
    DetectConfig,
    LocalizeConfig,
    RegisterConfig,
    RuntimeConfig,
)
from roel_service.errors import NoAnswerError
from roel_service.jobs.build import build_map, config_digest, run_build
from roel_service.jobs.inputs import BuildParameters
from roel_service.progress import ignore
from roel_service.scene.results import MAPPING_STAGES
from roel_service.wire.chunks import encode_chunk
from roel_service.wire.nouns import trajectory_to_proto
from roel_service.wire.provenance import camera_digest
from roel_service.wire.rlm import decode_map

from . import wireframe

CONFIG = preset("default")


class Pieces:
    """The recording in many small chunks."""

    width, height = wireframe.CAMERA.width, wireframe.CAMERA.height
    time_range_us = (wireframe.STEP_US, wireframe.DURATION_US - wireframe.STEP_US)

    def __init__(self, events, size):
        self._events, self._size = events, size

    def chunks(self):
        events = self._events
        for start in range(0, len(events), self._size):
            rows = slice(start, start + self._size)
            yield dataclasses.replace(
                events,
                **{name: getattr(events, name)[rows] for name in ("t_us", "x", "y", "polarity")},
            )


@pytest.fixture(scope="module")
def events():
    return wireframe.events()


@pytest.fixture(scope="module")
def built(events):
    return build_map(events, wireframe.trajectory(), wireframe.CAMERA, CONFIG)


def distance_to_bars_m(points):
    """(N,) distance of each point from the nearest bar, extended to a line."""
    start, end = wireframe.BARS[:, 0], wireframe.BARS[:, 1]
    direction = (end - start) / np.linalg.norm(end - start, axis=1)[:, None]
    offset = points[:, None] - start
    along = np.sum(offset * direction, axis=2)[..., None] * direction
    return np.linalg.norm(offset - along, axis=2).min(axis=1)


def test_the_lines_lie_on_the_bars(built):
    assert len(built.line_map) >= 4
    ends = built.line_map.segments.reshape(-1, 3)
    # Pixels are rounded, so a bar is seen within half a pixel: 9 mm at 2.1 m; depth is worse by
    # the ratio of distance and baseline, about 5, and what may be worse than that is left out.
    assert distance_to_bars_m(ends).max() < 1.5 * CONFIG.trim.max_error_m


def test_the_report_has_the_keys_of_the_command_line(built):
    assert list(built.report) == [
        "frame_count",
        "event_count",
        "line_count",
        "seconds",
        "seconds_total",
        "peak_rss_mib",
        "config",
        "versions",
    ]
    assert tuple(built.report["seconds"]) == MAPPING_STAGES
    assert built.report["line_count"] == len(built.line_map)
    assert built.report["config"] == to_tables(CONFIG)
    assert sum(built.report["seconds"].values()) <= built.report["seconds_total"]
    assert {"roel_service", "python", "numpy", "torch"} <= set(built.report["versions"])
    # Python with NumPy and OpenCV needs tens of MiB; a wrong unit would be off by 1024.
    assert 50 < built.report["peak_rss_mib"] < 8192
    assert json.loads(json.dumps(built.report, allow_nan=False)) == built.report


def test_the_file_says_what_it_was_made_of(built):
    provenance = decode_map(built.rlm_bytes).provenance
    assert provenance.config_digest == config_digest(CONFIG)
    assert provenance.camera_sha256 == camera_digest(wireframe.CAMERA)
    assert len(provenance.events_sha256) == len(provenance.poses_sha256) == 64


@pytest.mark.parametrize("worker_count", [1, 2])
def test_neither_chunks_nor_workers_change_a_byte(events, built, worker_count):
    config = dataclasses.replace(CONFIG, runtime=RuntimeConfig(worker_count=worker_count))
    source = Pieces(events, 3001)
    again = build_map(source, wireframe.trajectory(), wireframe.CAMERA, config)
    assert again.rlm_bytes == built.rlm_bytes


class Memory:
    """A cache that also says what was asked for."""

    def __init__(self):
        self.entries, self.missed = {}, []

    def get(self, stage, parameters):
        found = self.entries.get((stage, repr(parameters)))
        if found is None:
            self.missed.append(stage)
        return found

    def keep(self, stage, parameters, found):
        self.entries[stage, repr(parameters)] = found


class Unread(Pieces):
    """The recording, which nobody may read."""

    def chunks(self):
        raise AssertionError("the events are read")


def rebuilt(events, config, memory):
    """A build with a cache, the stages that it missed there, and the units of work it found."""
    memory.missed = []
    cached = {}

    def note(progress):
        cached[progress.stage] = max(progress.cached_count, cached.get(progress.stage, 0))

    source = Pieces(events, 5000) if not memory.entries else Unread(events, 5000)
    again = build_map(source, wireframe.trajectory(), wireframe.CAMERA, config, note, cache=memory)
    return again, memory.missed, {stage for stage, count in cached.items() if count}


@pytest.fixture(scope="module")
def first_build(events):
    """A build that has filled a cache."""
    memory = Memory()
    return rebuilt(events, CONFIG, memory)[0], memory


@pytest.fixture
def memory(first_build):
    copied = Memory()
    copied.entries = dict(first_build[1].entries)
    return copied


def test_the_second_build_takes_all_but_refinement_from_the_cache(events, built, memory):
    again, missed, cached = rebuilt(events, CONFIG, memory)
    assert again.rlm_bytes == built.rlm_bytes
    assert again.report["line_count"] == built.report["line_count"]
    assert again.report["event_count"] == built.report["event_count"]
    assert missed == []
    assert cached == set(MAPPING_STAGES) - {"refine", "trim"}
    assert again.report["seconds"]["detect"] == 0.0


def test_filling_a_cache_changes_no_byte(built, first_build):
    assert first_build[0].rlm_bytes == built.rlm_bytes


def test_sampled_matches_are_cached_with_the_first_lines(events):
    memory, config = Memory(), preset("paper")
    first, _, _ = rebuilt(events, config, memory)
    again, missed, cached = rebuilt(events, config, memory)
    assert again.rlm_bytes == first.rlm_bytes
    assert (missed, cached) == ([], set(MAPPING_STAGES) - {"refine", "trim"})


def changed(table, **fields):
    return dataclasses.replace(
        CONFIG, **{table: dataclasses.replace(getattr(CONFIG, table), **fields)}
    )


@pytest.mark.parametrize(
    ("config", "begins_with"),
    [
        (changed("trim", min_length_m=0.1), None),
        (changed("refine", iteration_count=9, event_weight=2.0, loss="squared"), None),
        (changed("refine", direction_sigma_deg=1.0, max_residual_px=3.0), None),
        (changed("refine_rounds", iteration_count=9), "match_global"),
        (changed("refine_rounds", direction_sigma_deg=1.0), "match_global"),
        (changed("match_global", min_overlap=0.55), "match_global"),
        (changed("refine_rounds", event_weight=2.0), "triangulate"),
        (changed("triangulate", min_inlier_count=6), "triangulate"),
        (changed("match_local", min_overlap=0.4), "triangulate"),
    ],
)
def test_a_rebuild_begins_with_the_first_stage_that_reads_what_changed(
    events, memory, config, begins_with
):
    _, missed, _ = rebuilt(events, config, memory)
    assert missed[:1] == ([begins_with] if begins_with else [])


def test_a_rebuild_with_other_parameters_is_what_a_fresh_build_is(events, memory):
    config = changed("refine", iteration_count=9)
    fresh = build_map(Pieces(events, 5000), wireframe.trajectory(), wireframe.CAMERA, config)
    assert rebuilt(events, config, memory)[0].rlm_bytes == fresh.rlm_bytes


def test_a_preview_is_a_map_of_the_same_recording(events, built):
    previews = []
    source, poses, camera = Pieces(events, 5000), wireframe.trajectory(), wireframe.CAMERA
    whole = build_map(source, poses, camera, CONFIG, on_preview=previews.append)
    assert whole.rlm_bytes == built.rlm_bytes
    (preview,) = previews
    assert len(preview.line_map) >= 4
    ends = preview.line_map.segments.reshape(-1, 3)
    assert distance_to_bars_m(ends).max() < 0.1
    assert decode_map(preview.rlm_bytes).provenance == decode_map(built.rlm_bytes).provenance


def test_a_child_builds_the_same_file_from_stored_bytes(events, built, tmp_path):
    chunks = [encode_chunk(chunk) for chunk in Pieces(events, 10_000).chunks()]
    event_file, pose_file = tmp_path / "events", tmp_path / "poses"
    event_file.write_bytes(b"".join(chunks))
    pose_file.write_bytes(trajectory_to_proto(wireframe.trajectory()).SerializeToString())
    parameters = BuildParameters(
        event_file=event_file,
        time_range_us=Pieces.time_range_us,
        chunk_lengths=[len(chunk) for chunk in chunks],
        pose_files=[pose_file],
        camera=wireframe.CAMERA,
        config=CONFIG,
    )
    version = run_build(parameters, ignore)
    assert version.rlm_bytes == built.rlm_bytes
    assert version.line_count == len(built.line_map)
    ends = built.line_map.segments.reshape(-1, 3)
    np.testing.assert_array_equal(version.bounds_m, [*ends.min(axis=0), *ends.max(axis=0)])


def test_a_map_of_too_few_lines_is_no_answer(events):
    # No line of this sensor is longer than its diagonal, 200 px.
    config = dataclasses.replace(CONFIG, detect=DetectConfig(min_length_px=201.0))
    with pytest.raises(NoAnswerError, match="at least 3 lines") as caught:
        build_map(events, wireframe.trajectory(), wireframe.CAMERA, config)
    assert caught.value.reason == "TOO_FEW_LINES"


def test_the_digest_follows_every_parameter_but_the_number_of_workers():
    other_seed = dataclasses.replace(CONFIG, runtime=RuntimeConfig(seed=1))
    more_workers = dataclasses.replace(CONFIG, runtime=RuntimeConfig(worker_count=9))
    assert config_digest(CONFIG) == config_digest(more_workers)
    register, localize = RegisterConfig(voxel_m=0.5), LocalizeConfig(min_score=0.9)
    later_jobs = dataclasses.replace(CONFIG, register=register, localize=localize)
    assert config_digest(CONFIG) == config_digest(later_jobs)
    assert len({config_digest(item) for item in (CONFIG, other_seed, preset("paper"))}) == 3
