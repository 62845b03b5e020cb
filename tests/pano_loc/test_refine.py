import numpy as np
import pytest

from roel_service.config.stages import LocalizeConfig
from roel_service.geometry.se3 import SE3
from roel_service.geometry.vectors import unit
from roel_service.pano_loc import refine_kernels
from roel_service.pano_loc.coverage import CROWD_REACH_RAD, line_points
from roel_service.pano_loc.prepare import prepare_map
from roel_service.pano_loc.refine import (
    FINAL_GATE_RAD,
    FINAL_SLACK_RAD,
    FINAL_WIDTHS_RAD,
    _refined,
    distinct,
    explained,
    sample_arcs,
)
from roel_service.pano_loc.search import Candidates
from roel_service.pano_loc.sight_kernels import Pairs, match_points, match_rays, near, see
from tests.pano_loc.rooms import map_of, pose, seen_from, segments_of

TRUTH = pose(1.7, 1.6, 1.4, 0.1, 0.2, 0.8)


@pytest.fixture(scope="module")
def prepared():
    return prepare_map(map_of(), LocalizeConfig())


def residual(T, ray, segment):
    normal = np.cross(segment[0] - T.translation, segment[1] - T.translation)
    return T.rotate(ray) @ normal / np.linalg.norm(normal)


@pytest.mark.parametrize("near", [1.0, 0.02])
def test_the_jacobian_is_the_derivative_of_the_residual(near):
    rng = np.random.default_rng(1)
    for _ in range(10):
        T = pose(*rng.normal(size=6))
        segment = T.translation + near * rng.normal(size=3) + rng.normal(size=(2, 3))
        ray = unit(rng.normal(size=3))
        sight = see(segment[None], T.rotation, T.translation)
        J = np.empty(6)
        refine_kernels.jacobian(ray, sight.spans[0], sight.normals[0], sight.moments_m2[0], J)
        step = 1e-6
        differences = [
            residual(T @ SE3.identity().retract(step * e), ray, segment)
            - residual(T @ SE3.identity().retract(-step * e), ray, segment)
            for e in np.eye(6)
        ]
        np.testing.assert_allclose(J, np.array(differences) / (2 * step), rtol=1e-5, atol=1e-7)


def test_the_equations_are_those_of_single_rays(prepared):
    """Rays of an arc on one line are summed up before: here ray by ray."""
    T = pose(1.72, 1.58, 1.41, 0.11, 0.19, 0.81)
    samples = sample_arcs(seen_from(TRUTH, segments_of()), 0.05)
    sight = see(prepared.segments, T.rotation, T.translation)
    pairs = near(sight, samples, FINAL_GATE_RAD, FINAL_GATE_RAD, 0.0)
    line, off, _ = match_rays(sight, samples, pairs, FINAL_GATE_RAD, FINAL_GATE_RAD)
    width_rad = FINAL_WIDTHS_RAD[0]
    H, g = refine_kernels.normal_equations(sight, samples, line, off, width_rad)
    arc = np.repeat(np.arange(len(samples.normals)), np.diff(samples.offsets))
    rays = samples.cosine[:, None] * samples.middles[arc]
    rays = rays + samples.sine[:, None] * samples.asides[arc]
    used = (line >= 0) & (np.abs(off) <= refine_kernels.CUTOFF_WIDTHS * width_rad)
    assert used.sum() > 100
    expected_H, expected_g, J = np.zeros((6, 6)), np.zeros((len(prepared), 6)), np.empty(6)
    for s in np.flatnonzero(used):
        j = line[s]
        refine_kernels.jacobian(rays[s], sight.spans[j], sight.normals[j], sight.moments_m2[j], J)
        robust = samples.weight[s] / (1.0 + (off[s] / width_rad) ** 2) ** 2
        expected_H += robust * np.outer(J, J)
        expected_g[j] += robust * off[s] * J
    np.testing.assert_allclose(H, expected_H, atol=1e-12)
    np.testing.assert_allclose(g, expected_g, atol=1e-12)


def test_rays_find_their_lines_at_the_true_pose(prepared):
    samples = sample_arcs(seen_from(TRUTH, segments_of()), 0.05)
    sight = see(prepared.segments, TRUTH.rotation, TRUTH.translation)
    pairs = near(sight, samples, FINAL_GATE_RAD, CROWD_REACH_RAD, 0.0)
    line, off, crowd = match_rays(sight, samples, pairs, FINAL_GATE_RAD, CROWD_REACH_RAD)
    # Lines that pass so close to the viewer that they have no image are left out.
    assert (line >= 0).mean() > 0.95
    assert np.abs(off).max() < 1e-9
    assert ((crowd > 0) == (line >= 0)).all()
    assert explained(samples, np.where(line >= 0, np.abs(off), np.inf), crowd) > 0.97


def test_short_lines_are_not_seen_from_behind():
    """Both planes through the ends of a short line hold the rays opposite to it, too."""
    segment = np.array([[[2.0, -0.01, 0.0], [2.0, 0.01, 0.0]]])
    arcs = seen_from(SE3.identity(), -np.array([[[2.0, -0.3, 0.0], [2.0, 0.3, 0.0]]]))
    samples = sample_arcs(arcs, 0.05)
    sight = see(segment, np.eye(3), np.zeros(3))
    assert len(near(sight, samples, FINAL_GATE_RAD, CROWD_REACH_RAD, 0.0).line) == 0
    off = match_points(
        line_points(segment, 0.1), np.eye(3), np.zeros(3), samples, FINAL_GATE_RAD, CROWD_REACH_RAD
    )[2]
    assert np.isinf(off).all()


def test_refinement_finds_the_exact_pose_from_near_by(prepared):
    T = TRUTH
    samples = sample_arcs(seen_from(T, segments_of()), 0.05)
    start = T.retract(np.array([0.01, -0.01, 0.01, 0.02, -0.02, 0.02]))
    guess = Candidates(
        poses=SE3(rotation=start.rotation[None], translation=start.translation[None]),
        score=np.zeros(1),
    )
    found = _refined(guess, samples, prepared, FINAL_WIDTHS_RAD, FINAL_SLACK_RAD, len(prepared))
    # Convergence of a few steps: a tenth of a millimetre and of a milliradian.
    np.testing.assert_allclose(T.local(found.poses[0]), np.zeros(6), atol=1e-4)


def test_of_two_poses_that_are_one_the_better_stays():
    turns, places = np.tile(np.eye(3), (3, 1, 1)), np.array([[0.0, 0, 0], [0.1, 0, 0], [2.0, 0, 0]])
    found = distinct(
        Candidates(poses=SE3(rotation=turns, translation=places), score=np.array([1.0, 2.0, 1.5])),
        5,
    )
    assert found.poses.translation[:, 0].tolist() == [0.1, 2.0]


@pytest.mark.parametrize("slack_deg", [0.0, 3.0])
def test_lines_nearby_are_all_that_rays_can_lie_on(prepared, slack_deg):
    """At poses within the slack, too."""
    samples = sample_arcs(seen_from(TRUTH, segments_of()), 0.05)
    first = see(prepared.segments, TRUTH.rotation, TRUTH.translation)
    turned = TRUTH.retract(np.array([0.4, -0.3, 0.5, 0.0, 0.0, 0.0]) * np.deg2rad(slack_deg))
    sight = see(prepared.segments, turned.rotation, turned.translation)
    pairs = near(first, samples, FINAL_GATE_RAD, FINAL_GATE_RAD, np.deg2rad(slack_deg))
    every = np.divmod(np.arange(len(prepared) * len(samples.normals)), len(samples.normals))
    reach_rad = FINAL_GATE_RAD
    line, off, _ = match_rays(sight, samples, pairs, FINAL_GATE_RAD, reach_rad)
    expected, expected_off, _ = match_rays(sight, samples, Pairs(*every), FINAL_GATE_RAD, reach_rad)
    assert (expected >= 0).mean() > 0.9
    np.testing.assert_array_equal(line, expected)
    np.testing.assert_array_equal(off, expected_off)


def test_the_widest_lines_of_a_place_are_those_that_take_up_most_of_its_view(prepared):
    place = np.array([1.0, 1.0, 1.2])
    few = refine_kernels.widest(prepared.segments, place, 5)

    def angles(segments):
        ends = unit(segments - place)
        return np.arccos(np.clip((ends[:, 0] * ends[:, 1]).sum(axis=1), -1, 1))

    assert len(few) == 5
    assert np.median(angles(few)) > np.quantile(angles(prepared.segments), 0.8)
    assert refine_kernels.widest(prepared.segments, place, 10**4).shape == prepared.segments.shape
