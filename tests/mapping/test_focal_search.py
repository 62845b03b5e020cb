import numpy as np
import pytest

from roel_service.mapping.focal_search import (
    LEAST_SIGMA,
    MAX_COST_COUNT,
    STEP,
    estimate_focal,
    with_focal,
)

from .synthetic import CAMERA


class Costs:
    """Of a recording whose focal length is so much longer than the given one."""

    def __init__(self, scale, sigma=0.002, noise=0.0):
        self.scale, self.sigma, self.noise = scale, sigma, noise
        self.asked = []
        self.rng = np.random.default_rng(3)

    def __call__(self, scale):
        self.asked.append(scale)
        off = (scale - self.scale) / self.sigma
        return 7000.0 + off**2 + self.noise * self.rng.normal()


def test_a_focal_length_that_is_right_stays():
    found = estimate_focal(costs := Costs(1.001))
    assert found.scale == pytest.approx(1.001, abs=1e-9)
    assert not found.is_applied
    assert len(costs.asked) == 5


def test_its_deviation_is_that_of_the_parabola_and_what_is_never_less():
    assert estimate_focal(Costs(1.0, sigma=0.004)).sigma == pytest.approx(
        np.hypot(0.004, LEAST_SIGMA)
    )


def test_costs_that_lie_off_the_parabola_make_it_less_sure():
    smooth, rough = (estimate_focal(Costs(1.0, noise=noise)) for noise in (0.0, 20.0))
    assert rough.sigma > 1.3 * smooth.sigma
    assert abs(rough.scale - 1.0) < 3.0 * rough.sigma


@pytest.mark.parametrize("scale", [0.974, 1.02, 1.038])
def test_one_that_is_off_is_found_also_beyond_the_first_steps(scale):
    found = estimate_focal(costs := Costs(scale))
    assert found.scale == pytest.approx(scale, abs=1e-9)
    assert found.is_applied
    assert len(costs.asked) == len(set(costs.asked)) <= MAX_COST_COUNT


def test_beyond_reach_nothing_is_told():
    found = estimate_focal(Costs(1.0 + 7.0 * STEP))
    assert found.sigma == np.inf
    assert not found.is_applied


def test_where_no_focal_length_is_best_nothing_is_told():
    # The least cost by chance, on a hill.
    found = estimate_focal(lambda scale: 0.0 if scale == 1.0 else 50.0 - 1e5 * (scale - 1.0) ** 2)
    assert found.sigma == np.inf


def test_another_focal_length_leaves_the_rest_of_a_camera():
    longer = with_focal(CAMERA, 1.02)
    assert (longer.fx_px, longer.fy_px) == (1.02 * CAMERA.fx_px, 1.02 * CAMERA.fy_px)
    assert (longer.cx_px, longer.width) == (CAMERA.cx_px, CAMERA.width)
