import logging

import numpy as np
import pytest

from roel_service.errors import Cancelled, EventsError, TrajectoryError
from roel_service.mapping.run import CountedEvents, MappingRun
from roel_service.progress import ignore
from roel_service.scene.events import EventStream
from roel_service.scene.results import MAPPING_STAGES, TrackStatus

from .synthetic import CAMERA, trajectory


class Chunks:
    """An event source of given chunks."""

    width, height = CAMERA.width, CAMERA.height

    def __init__(self, *times_us, time_range_us=None):
        self.times_us = times_us
        self.time_range_us = time_range_us

    def chunks(self):
        for t_us in self.times_us:
            zero = np.zeros(len(t_us), np.uint16)
            yield EventStream(
                t_us=np.asarray(t_us, np.int64),
                x=zero,
                y=zero,
                polarity=np.ones(len(t_us), np.int8),
                width=self.width,
                height=self.height,
            )


def counted(*times_us, first_us=0, last_us=100_000):
    events = CountedEvents(Chunks(*times_us), trajectory(first_us=first_us, last_us=last_us))
    for _ in events.chunks():
        pass
    return events


class TestCountedEvents:
    def test_events_are_counted_and_those_with_poses_too(self):
        events = counted([-10, 0, 50], [], [100_000, 100_001])
        assert (events.total_count, events.covered_count) == (5, 3)

    def test_empty_chunks_are_passed_over(self):
        events = CountedEvents(Chunks([], [1, 2], []), trajectory())
        assert [len(chunk) for chunk in events.chunks()] == [2]

    def test_the_time_range_is_that_of_the_source(self):
        assert CountedEvents(Chunks(time_range_us=(3, 9)), trajectory()).time_range_us == (3, 9)
        assert CountedEvents(Chunks(), trajectory()).time_range_us is None

    @pytest.mark.parametrize("times_us", [(), ([],), ([], [])])
    def test_no_events_are_an_error(self, times_us):
        with pytest.raises(EventsError, match="at least one event, found none") as caught:
            counted(*times_us).check_coverage()
        assert caught.value.reason == "NO_EVENTS"

    def test_poses_of_another_time_are_an_error_that_names_both_times(self):
        events = counted([5_000_000, 6_000_000])
        with pytest.raises(TrajectoryError) as caught:
            events.check_coverage()
        assert caught.value.reason == "POSE_COVERAGE_INSUFFICIENT"
        assert "5.000000 to 6.000000 s" in str(caught.value)
        assert "0.000000 to 0.100000 s" in str(caught.value)

    @pytest.mark.parametrize(("last_us", "enough"), [(1_000_000, True), (1_100_000, False)])
    def test_a_tenth_of_the_recording_needs_poses(self, last_us, enough):
        events = counted([0, last_us])
        if enough:
            events.check_coverage()
        else:
            with pytest.raises(TrajectoryError, match=r"found 9\.1%"):
                events.check_coverage()

    def test_events_of_one_instant_within_the_poses_are_covered(self):
        events = counted([50_000, 50_000])
        events.check_coverage()
        assert events.covered_count == 2

    def test_events_of_one_instant_beyond_the_poses_are_not(self):
        with pytest.raises(TrajectoryError):
            counted([200_000]).check_coverage()

    def test_what_is_left_out_is_logged(self, caplog):
        with caplog.at_level(logging.WARNING, logger="roel_service.mapping.run"):
            counted([0, 50_000, 100_000, 150_000]).check_coverage()
        assert "25.0 % of the events have no pose" in caplog.text


class TestMappingRun:
    def test_stages_are_timed_and_told(self):
        told = []
        run = MappingRun(told.append)
        with run.stage("triangulate"):
            run.step(1, 4)
        assert set(run.seconds) == set(MAPPING_STAGES)
        assert run.seconds["triangulate"] > 0
        assert [(p.stage, p.done_count, p.total_count) for p in told] == [
            ("triangulate", 0, 0),
            ("triangulate", 1, 4),
        ]

    @pytest.mark.parametrize(
        "stages",
        [
            ("match_local", "triangulate", "match_global", "refine", "trim"),
            ("match_local", "match_global", "triangulate", "refine", "trim"),
        ],
        ids=["reassociate", "sampled"],
    )
    def test_progress_never_goes_back(self, stages):
        told = []
        run = MappingRun(told.append)
        for done in range(5):
            run.step(done, 4)
        for name in stages:
            with run.stage(name):
                for done in range(3):
                    run.step(done, 2)
        fractions = [p.fraction for p in told]
        assert fractions == sorted(fractions)
        assert fractions[0] == 0.0
        assert fractions[-1] == 1.0

    def test_wall_clock_is_divided_in_proportion_to_the_work(self):
        run = MappingRun(ignore)
        run.share_wall_clock(6.0, {"detect": 8.0, "plane_fit": 4.0})
        assert run.seconds["detect"] == pytest.approx(4.0)
        assert run.seconds["plane_fit"] == pytest.approx(2.0)
        run.share_wall_clock(1.0, {"detect": 0.0, "plane_fit": 0.0})
        assert run.seconds["detect"] == pytest.approx(4.0)

    def test_statuses_are_counted(self):
        run = MappingRun(ignore)
        run.count([TrackStatus.MERGED, TrackStatus.TOO_SHORT, TrackStatus.MERGED])
        assert run.statuses == {TrackStatus.MERGED: 2, TrackStatus.TOO_SHORT: 1}

    def test_cancelling_passes_through_a_stage(self):
        def cancel(progress):
            raise Cancelled

        run = MappingRun(cancel)
        with pytest.raises(Cancelled), run.stage("trim"):
            pass
