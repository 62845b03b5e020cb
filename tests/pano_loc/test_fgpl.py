"""FGPL's stages, and what its released code does to maps that do not follow the world's axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from roel_service.config.stages import LocalizeConfig
from roel_service.evaluation.poses import rotation_errors_rad, translation_errors_m
from roel_service.geometry.se3 import rotation_angle, rotation_from_vector
from roel_service.geometry.vectors import angle_between, unit
from roel_service.pano_loc.arcs import PanoramaArcs
from roel_service.pano_loc.fgpl import distance_kernels
from roel_service.pano_loc.fgpl.distance_functions import functions_of_map, query_rays
from roel_service.pano_loc.fgpl.intersections import (
    Intersections,
    intersections_of_arcs,
    intersections_of_lines,
    without_gaps,
)
from roel_service.pano_loc.fgpl.line_extraction import longest, merge_lines
from roel_service.pano_loc.fgpl.localize import localize_fgpl, prepare_fgpl
from roel_service.pano_loc.fgpl.parameters import PUBLISHED, RELEASED
from roel_service.pano_loc.fgpl.pose_refinement import refine_pose, refine_rotation
from roel_service.pano_loc.fgpl.pose_search import rotation_candidates, translation_pool
from roel_service.pano_loc.fgpl.principal_directions import (
    class_of_arcs,
    class_of_lines,
    directions_of_arcs,
    directions_of_lines,
    vote_points,
)
from roel_service.pano_loc.fgpl.verdict import localize_judged, prepare_judged
from roel_service.scene.lines import LineMap
from roel_service.scene.results import LocalizationStatus
from tests.pano_loc.rooms import map_of, pose, seen_from, segments_of
from tests.pano_loc.wireframe import wireframe_panorama

TRUTH = pose(1.9, 1.7, 1.3, 0.02, -0.03, 0.8)
BOX = segments_of(furniture=())
RNG = np.random.default_rng(0)


def yawed(degrees):
    return pose(0.0, 0.0, 0.0, 0.0, 0.0, np.radians(degrees))


def directions_of(segments):
    return unit(segments[:, 1] - segments[:, 0])


def test_opposite_directions_share_their_votes():
    points = vote_points()
    assert len(points) == 5121
    assert (points @ points.T).min() > -1 + 1e-9
    assert len(query_rays()) == 642


@pytest.mark.parametrize("turn_rad", [0.3, np.pi, np.pi - 0.1])
def test_pieces_of_a_line_become_one_across_the_seam_as_well(turn_rad):
    angle = turn_rad + np.array([[0.0, 0.3], [0.2, 0.5], [0.45, 0.7]])
    rays = np.stack([np.cos(angle), np.sin(angle), 0.4 * np.ones_like(angle)], axis=-1)
    # A line at constant height is no great circle: use the chord's plane.
    ends = unit(rays)
    plane = unit(np.cross(ends[0, 0], ends[2, 1]))
    ends = unit(ends - (ends @ plane)[..., None] * plane)
    arcs = merge_lines(ends)
    assert len(arcs) == 1
    assert arcs.length_rad[0] == pytest.approx(float(angle_between(ends[0, 0], ends[2, 1])))
    assert abs(arcs.normals[0] @ plane) == pytest.approx(1.0)


def test_lines_that_do_not_overlap_or_point_elsewhere_stay_apart():
    angle = np.array([[0.0, 0.3], [0.4, 0.7]])
    flat = np.stack([np.cos(angle), np.sin(angle), np.zeros((2, 2))], axis=-1)
    tilted = flat[:1] @ rotation_from_vector(np.array([0.05, 0.0, 0.0])).T
    assert len(merge_lines(np.concatenate([flat, tilted]))) == 3


def test_no_lines_merge_to_none():
    assert len(merge_lines(np.empty((0, 2, 3)))) == 0


def test_the_longest_share_is_kept_and_all_where_it_is_none():
    arcs = seen_from(TRUTH, segments_of())
    assert len(longest(arcs, 0.25)) == len(arcs) // 4
    assert len(longest(arcs, 0.0)) == len(arcs)


def test_principal_directions_are_those_of_the_room():
    R = TRUTH.rotation.T
    seen = directions_of_arcs(seen_from(TRUTH, segments_of()).normals)
    known = directions_of_lines(directions_of(segments_of()))
    # Candidates are two degrees apart.
    assert np.abs(seen @ R).max(axis=1).min() > np.cos(np.radians(3.0))
    assert np.abs(known).max(axis=1).min() > np.cos(np.radians(3.0))
    assert np.linalg.det(seen) > 0
    assert np.linalg.det(known) > 0


def test_two_directions_are_completed_and_none_is_the_worlds():
    normals = unit(np.random.default_rng(1).normal(size=(30, 3)) * [1.0, 1.0, 0.0])
    rows = directions_of_arcs(normals)
    assert np.abs(rows[:, 2]).max() > np.cos(np.radians(3.0))
    np.testing.assert_array_equal(directions_of_arcs(np.empty((0, 3))), np.eye(3))
    one = directions_of_lines(np.tile([0.0, 0.0, 1.0], (9, 1)))
    assert np.abs(one[0] @ [0.0, 0.0, 1.0]) > np.cos(np.radians(3.0))


def test_rotations_are_all_that_lay_axes_on_directions():
    directions = rotation_from_vector(np.array([0.3, -0.7, 1.1]))
    found = rotation_candidates(directions)
    R = found.R_picture_axes
    assert len(R) == 24
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    apart = rotation_angle(R[:, None] @ np.swapaxes(R, 1, 2))
    assert (apart + 9 * np.eye(24)).min() > np.radians(89.0)
    for index in range(24):
        np.testing.assert_allclose(
            np.abs(np.sum(R[index].T * directions[found.order[index]], axis=1)), 1.0
        )
        # Pair k of the picture's directions has the axes of the pair that it is called.
        pair = found.pair_of(index)
        for k in range(3):
            axes = {int(np.flatnonzero(found.order[index] == d)[0]) for d in (k, (k + 1) % 3)}
            assert axes == {int(pair[k]), (int(pair[k]) + 1) % 3}


def test_a_box_has_three_intersections_a_corner():
    channel = class_of_lines(directions_of(BOX), np.eye(3), 0.9)
    found = intersections_of_lines(BOX, channel)
    assert np.bincount(found.pair).tolist() == [8, 8, 8]
    corners = BOX.reshape(-1, 3)
    distance = np.linalg.norm(found.points[:, None] - corners, axis=2)
    assert distance.min(axis=1).max() < 1e-9
    for k in range(3):
        lines = found.lines[found.pair == k]
        assert (channel[lines] == [k, (k + 1) % 3]).all()


def test_arcs_cross_where_the_corners_are_seen():
    arcs = seen_from(TRUTH, BOX)
    axes = TRUTH.rotation.T
    found = intersections_of_arcs(arcs, class_of_arcs(arcs.normals, axes.T, 0.5))
    corners = unit(TRUTH.inverse() @ BOX.reshape(-1, 3))
    cosine = found.points @ corners.T
    # Every corner is found; a few crossings are of lines that do not meet.
    assert (cosine.max(axis=0) > np.cos(1e-6)).all()
    assert (cosine.max(axis=1) > np.cos(1e-6)).sum() >= 24


def test_a_pair_without_lines_is_closed_up_as_released():
    points = np.eye(3)
    found = Intersections(points=points, pair=np.array([1, 1, 2]), lines=np.zeros((3, 2), np.int64))
    closed = without_gaps(found, np.array([1, 2, 2]))
    assert closed.pair.tolist() == [0, 0, 1]
    assert without_gaps(found, np.array([0, 1, 2])).pair.tolist() == [1, 1, 2]


def test_distance_functions_are_angles_to_the_nearest():
    arcs = PanoramaArcs.between(unit(RNG.normal(size=(4, 3))), unit(RNG.normal(size=(4, 3))))
    rays = query_rays()
    steps = np.linspace(0.0, 1.0, 2001)[:, None, None] * arcs.length_rad[:, None]
    along = np.cos(steps) * arcs.starts + np.sin(steps) * np.cross(arcs.normals, arcs.starts)
    nearest = (rays @ along.reshape(-1, 3).T).reshape(len(rays), len(steps), 4).max(axis=1)
    channel = np.array([0, 0, 1, -1])
    found = distance_kernels.line_distances(arcs.starts, arcs.ends, channel, rays)
    expected = np.arccos(np.minimum(nearest, 1.0))
    np.testing.assert_allclose(found[:, 0], expected[:, :2].min(axis=1), atol=2e-3)
    np.testing.assert_allclose(found[:, 1], expected[:, 2], atol=2e-3)
    np.testing.assert_allclose(found[:, 2], np.pi, atol=1e-6)
    near = distance_kernels.point_distances(arcs.starts[:2], np.array([0, 2]), rays)
    np.testing.assert_allclose(near[:, 2], np.arccos(rays @ arcs.starts[1]), atol=1e-3)


def test_released_point_channels_join_two_pairs():
    corners = Intersections(
        points=np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]),
        pair=np.array([0, 1]),
        lines=np.zeros((2, 2), np.int64),
    )
    segments, channel = BOX[:1], np.array([0])
    place = np.zeros((1, 3))
    by_pair, by_class = (
        functions_of_map(segments, channel, corners, place, points_by_class=flag)[0, :, 3:]
        for flag in (False, True)
    )
    np.testing.assert_array_equal(by_class[:, 0], by_pair[:, 0])
    np.testing.assert_array_equal(by_class[:, 1], by_pair[:, :2].min(axis=1))
    np.testing.assert_array_equal(by_class[:, 2], by_pair[:, 1])


def test_agreement_counts_values_and_matches_are_mutual():
    a, b = (RNG.uniform(0, 1, (n, 50)).astype(np.float32) for n in (3, 2))
    expected = (np.abs(a[:, None] - b) < np.float32(0.1)).sum(axis=2)
    np.testing.assert_array_equal(distance_kernels.agreement(a, b), expected)
    seen, known = unit(RNG.normal(size=(20, 3))), unit(RNG.normal(size=(30, 3)))
    none = np.zeros(30, np.int64)
    matches = distance_kernels.mutual_nearest(seen, none[:20], known, none, 0.8, True)
    cosine = seen @ known.T
    expected = [
        (i, j)
        for i, j in enumerate(cosine.argmax(axis=1))
        if cosine[:, j].argmax() == i and cosine[i, j] > 0.8
    ]
    assert [tuple(match) for match in matches] == expected


def test_the_pool_is_about_as_large_as_asked_and_inside():
    middles = RNG.uniform([0, 0, 0], [6.0, 4.0, 2.5], (60, 3))
    places = translation_pool(middles, 500, RNG)
    assert 250 < len(places) < 750
    assert (places > 0).all()
    assert (places < [6.0, 4.0, 2.5]).all()


def matched_lines(degrees):
    """Normals of arcs at the true rotation, and lines turned about the vertical."""
    segments = yawed(degrees) @ segments_of()
    truth = yawed(degrees) @ TRUTH
    arcs = seen_from(truth, segments)
    # `seen_from` sorts by length: take the line of each arc by its normal.
    d = directions_of(segments)
    line = np.abs((arcs.normals @ truth.rotation.T) @ d.T).argmin(axis=1)
    pairs = np.stack([d[line], d[np.roll(line, 7)]], axis=1)
    return truth, arcs.normals, pairs


@pytest.mark.parametrize(("degrees", "expected"), [(0.0, 0.0), (5.0, 5.0), (17.0, 17.0)])
def test_the_released_cost_turns_lines_to_the_axes(degrees, expected):
    truth, normals, pairs = matched_lines(degrees)
    start = rotation_from_vector(np.array([0.01, -0.02, 0.015])) @ truth.rotation
    published, released = (
        refine_rotation(start, normals, pairs, cost_per_axis=flag) for flag in (False, True)
    )
    # Adam's steps of 0.1 rad end within half a degree.
    assert np.degrees(rotation_angle(published @ truth.rotation.T)) < 0.5
    off_deg = np.degrees(rotation_angle(released @ truth.rotation.T))
    assert off_deg == pytest.approx(expected, abs=0.7)


def test_a_pose_without_matches_stays_coarse():
    nothing = Intersections(
        points=np.empty((0, 3)), pair=np.empty(0, np.int64), lines=np.empty((0, 2), np.int64)
    )
    refined = refine_pose(
        TRUTH, nothing, np.empty((0, 3)), nothing, np.empty((0, 3)), cost_per_axis=False
    )
    assert not refined.is_refined
    np.testing.assert_array_equal(refined.pose.matrix(), TRUTH.matrix())


FEW = replace(PUBLISHED, place_count=150)
FEW_RELEASED = replace(RELEASED, place_count=150)


@pytest.mark.parametrize(
    ("parameters", "degrees", "off_deg"), [(FEW, 17.0, 0.0), (FEW_RELEASED, 17.0, 17.0)]
)
def test_poses_are_found_but_turned_by_the_released_code(parameters, degrees, off_deg):
    motion = yawed(degrees)
    line_map = map_of(noise_m=0.003).transformed(motion)
    prepared = prepare_fgpl(line_map, parameters, np.random.default_rng(0))
    grey = wireframe_panorama(TRUTH, segments_of(), 1024)
    found = localize_fgpl(grey, [prepared], parameters)
    assert found is not None
    assert found.is_refined
    truth = motion @ TRUTH
    assert translation_errors_m(found.T_world_panorama, truth) < 0.1
    error_deg = np.degrees(rotation_errors_rad(found.T_world_panorama, truth))
    assert error_deg == pytest.approx(off_deg, abs=2.0)


def test_nothing_is_found_of_nothing():
    config = LocalizeConfig()
    judged = prepare_judged(map_of(), replace(FEW, place_count=30), config)
    blank = np.full((256, 512), 90, np.uint8)
    assert localize_fgpl(blank, [judged.asked], FEW) is None
    result = localize_judged(blank, [judged], FEW, config)
    assert result.status is LocalizationStatus.NOT_FOUND


@pytest.mark.parametrize("segments", [BOX[:1], BOX[:5]])
def test_maps_of_few_lines_are_no_error(segments):
    tiny = replace(FEW, place_count=30)
    prepared = prepare_fgpl(LineMap.from_segments(segments), tiny, np.random.default_rng(0))
    assert len(prepared.places) < 100
    found = localize_fgpl(wireframe_panorama(TRUTH, BOX, 512), [prepared], tiny)
    assert found is None or np.isfinite(found.T_world_panorama.matrix()).all()
