import numpy as np
import pytest

from roel_service.config.stages import LocalizeConfig
from roel_service.geometry.se3 import SE3
from roel_service.geometry.vectors import unit
from roel_service.pano_loc import refine_kernels
from roel_service.pano_loc.coverage import CROWD_REACH_RAD
from roel_service.pano_loc.prepare import prepare_map
from roel_service.pano_loc.refine import (
    FINAL_GATE_RAD,
    FINAL_SLACK_RAD,
    FINAL_WIDTHS_RAD,
    _refined,
    distinct,
    explained,
    lines_nearby,
    match,
    sample_arcs,
)
from roel_service.pano_loc.search import Candidates
from tests.pano_loc.rooms import map_of, pose, seen_from, segments_of


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
        normal, moment, *_ = refine_kernels.viewed_lines(segment[None], T.translation)
        J = np.empty(6)
        refine_kernels.jacobian(T.rotate(ray), segment, normal[0], moment[0], J)
        step = 1e-6
        differences = [
            residual(T.retract(step * e), ray, segment)
            - residual(T.retract(-step * e), ray, segment)
            for e in np.eye(6)
        ]
        np.testing.assert_allclose(J, np.array(differences) / (2 * step), rtol=1e-5, atol=1e-7)


def test_rays_find_their_lines_at_the_true_pose(prepared):
    T = pose(1.7, 1.6, 1.4, 0.1, 0.2, 0.8)
    samples = sample_arcs(seen_from(T, segments_of()), 0.05)
    nearby = lines_nearby(T, samples, prepared, CROWD_REACH_RAD)
    found = match(T, samples, prepared, nearby, FINAL_GATE_RAD)
    # Lines that pass so close to the viewer that they have no image are left out.
    assert (found.line >= 0).mean() > 0.95
    assert np.abs(found.residual).max() < 1e-9
    assert explained(T, samples, prepared, nearby) > 0.97


def test_refinement_finds_the_exact_pose_from_near_by(prepared):
    T = pose(1.7, 1.6, 1.4, 0.1, 0.2, 0.8)
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
    T = pose(1.7, 1.6, 1.4, 0.1, 0.2, 0.8)
    samples = sample_arcs(seen_from(T, segments_of()), 0.05)
    turned = T.retract(np.array([0.4, -0.3, 0.5, 0.0, 0.0, 0.0]) * np.deg2rad(slack_deg))
    nearby = lines_nearby(T, samples, prepared, FINAL_GATE_RAD, np.deg2rad(slack_deg))
    every = np.arange(len(prepared))
    offsets = np.arange(len(samples.normals) + 1) * len(every)
    all_lines = (offsets, np.tile(every, len(samples.normals)))
    found = match(turned, samples, prepared, nearby, FINAL_GATE_RAD)
    expected = match(turned, samples, prepared, all_lines, FINAL_GATE_RAD)
    # Far along the arc a line may be asked that its ends exclude: those have larger residuals.
    near = np.abs(expected.residual) < np.sin(FINAL_GATE_RAD)
    assert near.mean() > 0.9
    np.testing.assert_array_equal(found.line[near], expected.line[near])


def test_the_widest_lines_of_a_place_are_those_that_take_up_most_of_its_view(prepared):
    place = np.array([1.0, 1.0, 1.2])
    few = prepared.widest(place, 5)
    ends = unit(few.segments - place)
    angle = np.arccos(np.clip((ends[:, 0] * ends[:, 1]).sum(axis=1), -1, 1))
    every = unit(prepared.segments - place)
    others = np.arccos(np.clip((every[:, 0] * every[:, 1]).sum(axis=1), -1, 1))
    assert len(few) == 5
    assert np.median(angle) > np.quantile(others, 0.8)
    assert prepared.widest(place, 10**4) is prepared
