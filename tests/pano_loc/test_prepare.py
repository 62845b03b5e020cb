import io

import numpy as np

from roel_service.config.stages import LocalizeConfig
from roel_service.pano_loc.prepare import (
    MAX_PLACE_COUNT,
    MIN_PLACE_COUNT,
    PreparedMap,
    free_places,
    prepare_map,
)
from tests.pano_loc.rooms import map_of, segments_of


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


def test_small_maps_get_a_finer_grid():
    places, step_m = free_places(0.4 * segments_of(), np.eye(3), 0.4)
    assert step_m < 0.2
    assert len(places) > 0.3 * MIN_PLACE_COUNT


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
    first, second = prepared.to_arrays(), again.to_arrays()
    assert first.keys() == second.keys()
    for name, value in first.items():
        np.testing.assert_array_equal(second[name], value)
    assert again.step_m == prepared.step_m
