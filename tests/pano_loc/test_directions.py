import numpy as np

from roel_service.geometry.vectors import unit
from roel_service.pano_loc.directions import (
    class_of,
    principal_frame,
    shared_directions,
    vanishing_directions,
)
from tests.pano_loc.rooms import pose, seen_from, segments_of

# Two walls at 60 degrees: nothing is assumed about right angles.
SLANTED = unit(np.array([[1.0, 0.0, 0.0], [0.5, np.sqrt(0.75), 0.0], [0.0, 0.0, 1.0]]))


def directions_near(shared, count, rng):
    return unit(np.repeat(shared, count, axis=0) + rng.normal(0.0, 0.01, (count * len(shared), 3)))


def test_shared_directions_need_no_right_angles():
    rng = np.random.default_rng(0)
    lines = np.concatenate([directions_near(SLANTED, 30, rng), unit(rng.normal(size=(20, 3)))])
    found = shared_directions(lines, np.ones(len(lines)))[:3]
    cosine = np.abs(SLANTED @ found.T)
    assert sorted(cosine.argmax(axis=1)) == [0, 1, 2]
    assert np.degrees(np.arccos(np.minimum(cosine.max(axis=1), 1.0))).max() < 0.5


def test_lines_far_from_every_shared_direction_have_no_class():
    lines = np.array([[1.0, 0.01, 0.0], [0.0, -0.05, -1.0], [0.6, 0.0, 0.8]])
    assert class_of(unit(lines), np.eye(3)).tolist() == [0, 2, -1]


def test_vanishing_directions_are_those_of_the_room():
    T = pose(1.9, 1.4, 1.5, 0.3, -0.2, 0.7)
    found = vanishing_directions(seen_from(T, segments_of(), noise_rad=0.001))[:3]
    cosine = np.abs(T.rotate(found))
    assert sorted(cosine.argmax(axis=0)) == [0, 1, 2]
    assert np.degrees(np.arccos(np.minimum(cosine.max(axis=0), 1.0))).max() < 0.3


def test_principal_frame_is_a_rotation_however_many_directions_there_are():
    for count in range(4):
        frame = principal_frame(SLANTED[:count], np.empty((0, 3)))
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(frame) > 0
        assert count == 0 or np.allclose(frame[0], SLANTED[0])


def test_where_one_direction_is_shared_the_longest_line_beside_it_says_what_turns_with_the_map():
    lines = unit(np.array([SLANTED[0], SLANTED[0] + 0.01, SLANTED[1], SLANTED[2]]))
    frame = principal_frame(SLANTED[:1], lines)
    np.testing.assert_allclose(frame[0], SLANTED[0])
    np.testing.assert_allclose(frame[1], [0.0, 1.0, 0.0], atol=1e-12)
