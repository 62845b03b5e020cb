import dataclasses
import io

import numpy as np
import pytest

from roel_service.config.stages import RegisterConfig
from roel_service.errors import CloudError, NoAnswerError
from roel_service.geometry.se3 import SE3, rotation_angle, rotation_from_vector
from roel_service.geometry.segments import sample_segments
from roel_service.register.align import Level, align
from roel_service.register.alignment import Alignment
from roel_service.register.prepare import PreparedCloud, prepare_cloud, prepare_map
from roel_service.register.register import METHODS, register_map
from roel_service.register.source import Samples, source_of_map
from roel_service.register.verdict import overlap
from roel_service.register.vertical import Vertical
from roel_service.scene.clouds import PointCloud
from roel_service.scene.lines import LineMap
from roel_service.scene.results import StopReason, Verdict
from tests.register.rooms import room_cloud, room_map

CONFIG = RegisterConfig()
NUDGE = SE3(rotation=rotation_from_vector(np.array([0.02, -0.03, 0.05])), translation=[0.03, 0, 0])


@pytest.fixture(scope="module")
def prepared():
    return prepare_cloud(room_cloud(), CONFIG)


def errors(found, true=None):
    """Rotation in degrees and translation in mm between two transforms."""
    off = found @ (true or SE3.identity()).inverse()
    return np.degrees(rotation_angle(off.rotation)), 1e3 * np.linalg.norm(off.translation)


def test_point_icp_comes_close_from_a_close_start(prepared):
    result = register_map(room_map(), prepared, CONFIG, method="point", T_init=NUDGE)
    degrees, millimetres = errors(result.T_target_source)
    assert degrees < 1.0
    assert millimetres < 30.0
    assert result.converged
    assert result.verdict is Verdict.ACCEPTED


@pytest.mark.parametrize("kind", ["cloud", "map"])
def test_a_prepared_target_is_kept_as_plain_arrays(prepared, kind):
    target = prepared if kind == "cloud" else prepare_map(room_map(), CONFIG)
    file = io.BytesIO()
    np.savez(file, **target.to_arrays())
    file.seek(0)
    with np.load(file, allow_pickle=False) as arrays:
        again = PreparedCloud.from_arrays(arrays)
    assert again.size_bytes == target.size_bytes > 0
    first, second = (register_map(room_map(), t, CONFIG, T_init=NUDGE) for t in (target, again))
    np.testing.assert_array_equal(second.T_target_source.matrix(), first.T_target_source.matrix())
    assert second.verdict is first.verdict


@pytest.mark.parametrize("method", ["plane", "line"])
def test_single_pulls_come_close_from_a_close_start(prepared, method):
    result = register_map(room_map(), prepared, CONFIG, method=method, T_init=NUDGE)
    degrees, millimetres = errors(result.T_target_source)
    assert degrees < 0.2
    assert millimetres < 5.0
    assert result.verdict is Verdict.ACCEPTED


def turned_start(seed):
    """30 degrees about a random axis, 0.3 m in a random direction."""
    axis, shift = np.random.default_rng(seed).normal(size=(2, 3))
    return SE3(
        rotation=rotation_from_vector(np.radians(30) * axis / np.linalg.norm(axis)),
        translation=0.3 * shift / np.linalg.norm(shift),
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_default_comes_home_from_30_degrees_and_30_centimetres(prepared, seed):
    result = register_map(room_map(), prepared, CONFIG, T_init=turned_start(seed))
    degrees, millimetres = errors(result.T_target_source)
    assert degrees < 0.1
    assert millimetres < 5.0
    assert result.verdict is Verdict.ACCEPTED
    assert result.converged
    assert len(result.weak_directions) == 0


@pytest.mark.parametrize("seed", range(4))
def test_global_finds_any_heading_and_place(prepared, seed):
    rng = np.random.default_rng(seed)
    T = SE3(
        rotation=rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])),
        translation=rng.uniform(-5.0, 5.0, 3),
    )
    result = register_map(room_map().transformed(T), prepared, CONFIG, method="global")
    degrees, millimetres = errors(result.T_target_source @ T)
    assert degrees < 0.1
    assert millimetres < 5.0
    assert result.verdict is Verdict.ACCEPTED


def test_global_finds_any_rotation_if_gravity_is_unknown(prepared):
    T = SE3(rotation=rotation_from_vector(np.array([1.0, -2.0, 0.5])), translation=[1.0, 2.0, 3.0])
    free = dataclasses.replace(CONFIG, gravity_aligned=False)
    result = register_map(room_map().transformed(T), prepared, free, method="global")
    degrees, millimetres = errors(result.T_target_source @ T)
    assert degrees < 0.1
    assert millimetres < 5.0


def test_global_keeps_up_up_where_both_sides_tell_it(prepared):
    tilt = SE3(rotation=rotation_from_vector(np.array([0.9, -0.5, 0.0])), translation=[1.0, 2.0, 3])
    up = tilt.rotation @ [0.0, 0.0, 1.0]
    vertical = Vertical(up_source=up, up_target=[0.0, 0.0, 1.0])
    tilted = room_map().transformed(tilt)
    result = register_map(tilted, prepared, CONFIG, method="global", vertical=vertical)
    degrees, millimetres = errors(result.T_target_source @ tilt)
    assert degrees < 0.1
    assert millimetres < 5.0
    # What is up may also be wrong: every heading about it is far from the truth then.
    wrong = Vertical(up_source=-up, up_target=[0.0, 0.0, 1.0])
    result = register_map(tilted, prepared, CONFIG, method="global", vertical=wrong)
    assert errors(result.T_target_source @ tilt)[0] > 90.0


@pytest.mark.parametrize("method", ["auto", "global"])
def test_a_map_onto_a_map(method):
    T = SE3(rotation=rotation_from_vector(np.array([0.0, 0.0, 0.4])), translation=[0.3, -0.4, 0.1])
    target = room_map(seed=5)
    result = register_map(room_map().transformed(T), target, CONFIG, method=method, T_init=None)
    degrees, millimetres = errors(result.T_target_source @ T)
    assert degrees < 0.2
    assert millimetres < 5.0
    assert result.verdict is Verdict.ACCEPTED


def test_a_map_of_unknown_unit_is_scaled(prepared):
    scaled = LineMap.from_segments(0.37 * room_map().segments)
    config = dataclasses.replace(CONFIG, estimate_scale=True)
    result = register_map(scaled, prepared, config, method="global")
    assert result.scale == pytest.approx(1 / 0.37, rel=2e-3)
    assert max(errors(result.T_target_source)) < 10.0


def test_a_symmetric_room_has_two_answers_and_says_so():
    boxes = (((0.0, 0.0, 0.0), (4.0, 3.0, 2.5)),)
    cloud = prepare_cloud(room_cloud(boxes), CONFIG)
    result = register_map(room_map(boxes), cloud, CONFIG, method="global")
    assert result.verdict is Verdict.AMBIGUOUS
    (other,) = result.alternatives
    half_turn = other.T_target_source @ result.T_target_source.inverse()
    assert np.degrees(rotation_angle(half_turn.rotation)) == pytest.approx(180.0, abs=0.1)
    assert other.fitness == pytest.approx(result.fitness, abs=0.02)
    assert 0.85 * result.agreement <= other.score <= result.agreement


def test_a_map_of_another_room_is_rejected(prepared):
    other = (((0.0, 0.0, 0.0), (6.0, 2.1, 3.0)), ((2.0, 0.4, 0.0), (2.6, 1.4, 1.9)))
    result = register_map(room_map(other), prepared, CONFIG, method="global")
    assert result.verdict is Verdict.REJECTED


@pytest.mark.parametrize(("share", "verdict"), [(0.5, Verdict.ACCEPTED), (0.2, Verdict.REJECTED)])
def test_a_cloud_judges_the_part_of_the_map_inside_it(share, verdict):
    cloud = room_cloud()
    end_m = np.quantile(cloud.points[:, 0], share)
    part = PointCloud(points=cloud.points[cloud.points[:, 0] <= end_m])
    result = register_map(room_map(), part, CONFIG, T_init=NUDGE)
    assert result.verdict is verdict
    assert result.inside < share + 0.1
    assert result.fitness <= result.inside
    if verdict is Verdict.ACCEPTED:
        assert max(errors(result.T_target_source)) < 10.0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "directions",
    [np.eye(3)[:1], np.eye(3)[:2], np.array([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])],
    ids=["a line", "a floor", "a wall"],
)
def test_clouds_without_extent_in_some_direction_are_never_accepted(method, directions):
    rng = np.random.default_rng(0)
    cloud = PointCloud(points=rng.uniform(0.0, 4.0, (3000, len(directions))) @ directions)
    result = register_map(room_map(), cloud, CONFIG, method=method)
    assert result.verdict is not Verdict.ACCEPTED


@pytest.mark.parametrize("noise_m", [0.003, 0.0])
def test_one_plane_leaves_three_directions_open(noise_m):
    rng = np.random.default_rng(0)
    floor = np.c_[rng.uniform(0.0, 4.0, (20_000, 2)), rng.normal(0.0, noise_m, 20_000)]
    lines = rng.uniform(0.5, 3.5, (30, 2, 3)) * [1.0, 1.0, 0.0]
    result = register_map(LineMap.from_segments(lines), PointCloud(points=floor), CONFIG)
    assert result.verdict is not Verdict.ACCEPTED
    # Shifts along the floor, and turns about its normal.
    assert len(result.weak_directions) == 3
    np.testing.assert_allclose(result.weak_directions[:, [0, 1, 5]], 0.0, atol=0.05)


@pytest.fixture(scope="module")
def found(prepared):
    return register_map(room_map(), prepared, CONFIG, T_init=NUDGE).T_target_source


@pytest.mark.parametrize(
    "points",
    [
        np.random.default_rng(0).normal(size=(150, 3)),
        np.linspace(0.0, 3.0, 200)[:, None] * [1.0, 0.5, 0.2],
        np.zeros((120, 3))
        + [1.0, 2.0, 1.0]
        + 1e-2 * np.random.default_rng(1).normal(size=(120, 3)),
    ],
    ids=["scattered", "one line", "one place"],
)
@pytest.mark.parametrize("method", ["auto", "global", "plane", "line"])
def test_clouds_without_surfaces_are_no_place_to_rely_on(points, method):
    segments = room_map().segments
    if np.ptp(points) < 0.2:
        segments = 0.02 * segments
    result = register_map(
        LineMap.from_segments(segments), PointCloud(points=points), CONFIG, method=method
    )
    assert result.verdict is not Verdict.ACCEPTED


class TestProperties:
    """What must hold whatever the numbers are."""

    MOTION = SE3(
        rotation=rotation_from_vector(np.array([0.2, -0.1, 0.4])), translation=[0.3, -1.0, 0.5]
    )
    # Nearest neighbours of moved points differ a little: voxels and cells lie elsewhere.
    BOUND = 0.05, 2.0

    def assert_same(self, found, expected):
        degrees, millimetres = errors(found, expected)
        assert degrees < self.BOUND[0]
        assert millimetres < self.BOUND[1]

    def test_a_motion_of_the_map_moves_the_answer(self, prepared, found):
        moved = room_map().transformed(self.MOTION)
        T_init = NUDGE @ self.MOTION.inverse()
        result = register_map(moved, prepared, CONFIG, T_init=T_init)
        self.assert_same(result.T_target_source @ self.MOTION, found)

    def test_a_motion_of_the_cloud_moves_the_answer(self, found):
        cloud = PointCloud(points=self.MOTION @ room_cloud().points.astype(np.float64))
        result = register_map(room_map(), cloud, CONFIG, T_init=self.MOTION @ NUDGE)
        self.assert_same(self.MOTION.inverse() @ result.T_target_source, found)

    def test_the_order_of_lines_changes_nothing(self, prepared, found):
        order = np.random.default_rng(3).permutation(len(room_map()))
        shuffled = LineMap(
            **{
                field.name: getattr(room_map(), field.name)[order]
                for field in dataclasses.fields(LineMap)
            }
        )
        result = register_map(shuffled, prepared, CONFIG, T_init=NUDGE)
        np.testing.assert_allclose(result.T_target_source.matrix(), found.matrix(), atol=1e-9)

    def test_the_order_of_points_changes_nothing(self, prepared, found):
        cloud = room_cloud()
        order = np.random.default_rng(4).permutation(len(cloud))
        shuffled = PointCloud(points=cloud.points[order])
        result = register_map(room_map(), shuffled, CONFIG, T_init=NUDGE)
        np.testing.assert_allclose(result.T_target_source.matrix(), found.matrix(), atol=1e-6)

    def test_samples_beyond_the_gate_change_nothing(self, prepared):
        samples = source_of_map(room_map()).samples
        far = dataclasses.replace(samples, points=samples.points + np.array([0.0, 0.0, 9.0]))
        both = Samples(
            **{
                field.name: np.concatenate([getattr(samples, field.name), getattr(far, field.name)])
                for field in dataclasses.fields(Samples)
            }
        )
        level = Level(first_scale_m=0.05, last_scale_m=0.01, sample_count=10**6, step_count=60)
        start = Alignment(
            T_target_source=NUDGE, stop_reason=StopReason.ITERATION_LIMIT, iteration_count=0
        )
        alone, among = (align(s, prepared, start, level).T_target_source for s in (samples, both))
        # Steps end below 2e-5 rad and m.
        np.testing.assert_allclose(among.matrix(), alone.matrix(), atol=1e-4)

    def test_lines_beyond_the_gate_change_little(self, prepared, found):
        far = room_map().segments[:6] + np.array([0.0, 0.0, 9.0])
        segments = np.concatenate([room_map().segments, far])
        outliers = dataclasses.replace(
            LineMap.from_segments(segments), sigma_m=np.full(len(segments), 0.01)
        )
        result = register_map(outliers, prepared, CONFIG, T_init=NUDGE)
        self.assert_same(result.T_target_source, found)

    def test_clouds_onto_one_another_forwards_and_backwards_are_inverse(self, prepared):
        other = room_cloud(seed=7)
        moved = PointCloud(points=self.MOTION @ other.points.astype(np.float64))
        there = prepare_cloud(moved, CONFIG)
        forward = register_map(prepared, there, CONFIG, T_init=self.MOTION @ NUDGE)
        backward = register_map(there, prepared, CONFIG, T_init=(self.MOTION @ NUDGE).inverse())
        self.assert_same(forward.T_target_source @ backward.T_target_source, SE3.identity())
        self.assert_same(forward.T_target_source, self.MOTION)


@pytest.mark.parametrize(
    ("points", "found"),
    [
        (np.empty((0, 3)), "at least 100 points, found 0"),
        (np.eye(3), "at least 100 points, found 3"),
    ],
    ids=["empty", "three points"],
)
def test_what_is_no_place_is_refused(points, found):
    with pytest.raises(CloudError, match=found) as caught:
        register_map(room_map(), PointCloud(points=points), CONFIG)
    assert caught.value.reason == "CLOUD_INVALID"


def test_a_map_without_lines_has_no_answer(prepared):
    with pytest.raises(NoAnswerError) as caught:
        register_map(LineMap.from_segments(np.empty((0, 2, 3))), prepared, CONFIG)
    assert caught.value.reason == "TOO_FEW_LINES"


@pytest.mark.parametrize(
    ("factor", "unit"), [(1e3, "millimetres and metres"), (1e-3, "metres and")]
)
def test_a_unit_that_is_off_by_a_thousand_is_named(factor, unit):
    cloud = room_cloud(count=1000)
    scaled = PointCloud(points=cloud.points * np.float32(factor))
    with pytest.raises(CloudError, match=f"factor of about 1000, as between {unit}") as caught:
        register_map(room_map(), scaled, CONFIG)
    assert caught.value.reason == "CLOUD_UNIT"


def test_overlap_is_how_much_of_the_target_around_it_the_map_explains(prepared):
    points, line = sample_segments(room_map().segments, 0.02)
    whole, every_third = overlap(points, prepared), overlap(points[line % 3 == 0], prepared)
    assert whole > 0.9
    assert 0.15 < every_third < 0.6
    assert overlap(points + 100.0, prepared) == 0.0
