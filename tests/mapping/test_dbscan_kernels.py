import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csgraph
from scipy.spatial.distance import cdist

from roel_service.mapping.dbscan_kernels import dbscan


def reference(points, radius, min_count):
    """Straight from the definition."""
    distance = cdist(points, points)
    near = distance <= radius
    core = near.sum(axis=1) >= min_count
    cluster = csgraph.connected_components(near & core[:, None] & core[None])[1]
    to_core = np.where(near & core[None], distance, np.inf)
    member = np.where(core, np.arange(len(points)), to_core.argmin(axis=1))
    return np.where(np.isfinite(to_core.min(axis=1)), cluster[member], -1)


def numbered(labels):
    """Labels by the order of their first points."""
    numbers = {}
    return [-1 if label < 0 else numbers.setdefault(label, len(numbers)) for label in labels]


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 60), st.integers(1, 6), st.floats(0.3, 3.0), st.integers(0, 10_000))
def test_it_follows_the_definition(count, min_count, radius, draw):
    points = np.random.default_rng(draw).uniform(-3, 3, (count, 3))
    found = dbscan(points, radius, min_count)
    assert found.tolist() == numbered(reference(points, radius, min_count))


def test_groups_apart_are_clusters_and_lone_points_are_none():
    group = np.random.default_rng(0).uniform(0, 0.5, (20, 3))
    places = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [4.0, 4.0, -7.0]])
    points = np.concatenate([*(group + place for place in places), [[100.0, 0.0, 0.0]]])
    assert dbscan(points, 1.0, 5).tolist() == [0] * 20 + [1] * 20 + [2] * 20 + [-1]


def test_cells_at_the_end_of_a_row_are_no_neighbours_of_the_next_row():
    # The last cell along one axis and the first one of the next row along another.
    points = np.array([[0.0, 0.0, 9.5], [0.0, 1.5, 0.5], [0.0, 0.0, 0.0], [0.0, 9.0, 9.5]])
    assert dbscan(points, 1.0, 1).tolist() == [0, 1, 2, 3]


def test_equal_points_are_one_cluster():
    assert dbscan(np.ones((1000, 3)), 0.5, 1000).tolist() == [0] * 1000


@pytest.mark.parametrize("shift", [0.0, -1e6, 1e6])
def test_where_the_points_lie_does_not_matter(shift):
    points = np.random.default_rng(1).integers(0, 6, (80, 3)).astype(float)
    np.testing.assert_array_equal(dbscan(points + shift, 1.1, 3), dbscan(points, 1.1, 3))


def test_no_points_have_no_cluster():
    assert len(dbscan(np.empty((0, 3)), 1.0, 1)) == 0
