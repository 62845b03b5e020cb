import io

import numpy as np

from roel_service.config.stages import LocalizeConfig
from roel_service.geometry import sphere
from roel_service.geometry.vectors import angle_between, unit
from roel_service.pano_loc import fields_kernels
from roel_service.pano_loc.prepare import (
    MAX_PLACE_COUNT,
    PreparedMap,
    cube_rays,
    free_places,
    preparation_key,
    prepare_map,
)
from tests.pano_loc.rooms import map_of, segments_of


def distance_to_arc(ray, start, end):
    """rad, by the densest of samples."""
    return angle_between(sphere.sample_arc(start, end, 2001), ray).min()


def test_fields_hold_the_angle_to_the_nearest_arc_of_each_class():
    rng = np.random.default_rng(0)
    starts, ends = unit(rng.normal(size=(2, 12, 3)))
    channel = np.arange(12) % 3 - 1
    rays = unit(rng.normal(size=(40, 3)))
    field = fields_kernels.nearest_arcs(starts, ends, channel, 3, rays)
    for k in range(2):
        members = np.flatnonzero(channel == k)
        expected = [min(distance_to_arc(q, starts[a], ends[a]) for a in members) for q in rays]
        # Half a step of the table.
        np.testing.assert_allclose(
            field[:, k] / fields_kernels.STEPS_PER_RAD, expected, atol=0.51 / 63
        )
    assert (field[:, 2] == fields_kernels.EMPTY).all()


def test_an_empty_class_agrees_with_nothing():
    field = np.full((4, 2), 10, np.uint8)
    field[:, 1] = fields_kernels.EMPTY
    score = fields_kernels.agreement(field[None], field, np.array([0.7, 0.3]), 6)
    np.testing.assert_allclose(score, [0.7])


def test_query_directions_stay_when_the_cube_turns():
    rays = cube_rays(4)
    for turned in (rays[:, [1, 2, 0]], rays * [1, -1, -1], rays[:, [1, 0, 2]] * [-1, 1, 1]):
        assert np.abs(turned[:, None] - rays[None]).sum(axis=2).min(axis=1).max() < 1e-12


def test_places_lie_inside_the_room_and_close_together():
    places, step_m = free_places(segments_of(), np.eye(3), 0.4)
    assert step_m == 0.4
    assert (places > 0).all()
    assert (places < [4.0, 3.2, 2.5]).all()
    middle = np.random.default_rng(0).uniform([0.8, 0.8, 0.8], [3.2, 2.4, 1.7], (50, 3))
    nearest = np.linalg.norm(places[None] - middle[:, None], axis=2).min(axis=1)
    assert nearest.max() < 0.4 * np.sqrt(3) / 2


def test_large_maps_get_a_wider_grid_and_not_more_places():
    places, step_m = free_places(20.0 * segments_of(), np.eye(3), 0.4)
    assert step_m > 0.4
    assert len(places) <= 1.2 * MAX_PLACE_COUNT


def test_an_empty_map_can_be_prepared():
    prepared = prepare_map(map_of().__class__.from_segments(np.empty((0, 2, 3))), LocalizeConfig())
    assert len(prepared) == 0
    assert len(prepared.places) == 0


def test_a_prepared_map_is_kept_as_plain_arrays():
    prepared = prepare_map(map_of(), LocalizeConfig())
    file = io.BytesIO()
    np.savez(file, **prepared.to_arrays())
    file.seek(0)
    with np.load(file, allow_pickle=False) as arrays:
        again = PreparedMap.from_arrays(arrays)
    for name, value in vars(prepared).items():
        np.testing.assert_array_equal(getattr(again, name), value)


def test_the_key_of_a_preparation_tells_maps_and_parameters_apart():
    config = LocalizeConfig()
    key = preparation_key("sha256:1", config)
    assert key == preparation_key("sha256:1", LocalizeConfig())
    assert key != preparation_key("sha256:2", config)
    assert key != preparation_key("sha256:1", LocalizeConfig(grid_step_m=0.3))
