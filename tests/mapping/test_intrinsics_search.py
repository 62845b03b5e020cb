import numpy as np
import pytest

from roel_service.mapping.intrinsics_search import (
    LEAST_SIGMA,
    MAX_PASS_COUNT,
    MAX_STEP_COUNT,
    STEP,
    estimate_intrinsics,
    least_cost,
    with_focal,
    with_principal_x,
    with_principal_y,
)

from .synthetic import CAMERA

MAX_COST_COUNT = 2 * MAX_STEP_COUNT + 1
NUMBERS = ("fx_px", "fy_px", "cx_px", "cy_px")


class Costs:
    """Of a recording whose calibration is off by a share of the focal length."""

    def __init__(self, share, sigma=0.002, noise=0.0):
        self.share, self.sigma, self.noise = share, sigma, noise
        self.asked = []
        self.rng = np.random.default_rng(3)

    def __call__(self, share):
        self.asked.append(share)
        off = (share - self.share) / self.sigma
        return 7000.0 + off**2 + self.noise * self.rng.normal()


def test_the_least_cost_is_that_of_the_parabola():
    share, _ = least_cost(costs := Costs(0.001))
    assert share == pytest.approx(0.001, abs=1e-9)
    assert len(costs.asked) == 5


def test_its_deviation_is_that_of_the_parabola_and_what_is_never_less():
    _, sigma = least_cost(Costs(0.0, sigma=0.004))
    assert sigma == pytest.approx(np.hypot(0.004, LEAST_SIGMA))


def test_costs_that_lie_off_the_parabola_make_it_less_sure():
    (_, smooth), (share, rough) = (least_cost(Costs(0.0, noise=noise)) for noise in (0.0, 20.0))
    assert rough > 1.3 * smooth
    assert abs(share) < 3.0 * rough


@pytest.mark.parametrize("share", [-0.026, 0.02, 0.038])
def test_one_that_is_off_is_found_also_beyond_the_first_steps(share):
    found, _ = least_cost(costs := Costs(share))
    assert found == pytest.approx(share, abs=1e-9)
    assert len(costs.asked) == len(set(costs.asked)) <= MAX_COST_COUNT


def test_beyond_reach_nothing_is_told():
    assert least_cost(Costs(7.0 * STEP)) == (0.0, np.inf)


def test_where_no_number_is_best_nothing_is_told():
    # The least cost by chance, on a hill.
    found = least_cost(lambda share: 0.0 if share == 0.0 else 50.0 - 1e5 * share**2)
    assert found == (0.0, np.inf)


class Recording:
    """Costs least with one camera."""

    def __init__(self, true):
        self.true, self.asked = true, []

    def __call__(self, camera):
        self.asked.append(camera)
        off_px = [getattr(camera, name) - getattr(self.true, name) for name in NUMBERS]
        return 7000.0 + float(np.square(np.array(off_px) / (0.002 * self.true.fx_px)).sum())


def test_all_three_are_mended():
    true = with_principal_y(with_principal_x(with_focal(CAMERA, 0.02), -3.0), 4.0)
    found = estimate_intrinsics(CAMERA, recording := Recording(true))
    assert found.focal.change == pytest.approx(0.02, abs=1e-9)
    assert found.principal_x.change == pytest.approx(-3.0, abs=1e-6)
    assert found.principal_y.change == pytest.approx(4.0, abs=1e-6)
    for name in NUMBERS:
        assert getattr(found.camera, name) == pytest.approx(getattr(true, name), abs=1e-6)
    assert len(recording.asked) == len(set(recording.asked)) <= MAX_PASS_COUNT * 3 * MAX_COST_COUNT


def test_numbers_that_shift_each_other_are_looked_for_again():
    true = with_principal_y(with_focal(CAMERA, 0.03), 3.0)

    def cost(camera):
        focal = (camera.fx_px / true.fx_px - 1.0) / 0.002
        y = (camera.cy_px - true.cy_px) / (0.002 * true.fy_px)
        return 7000.0 + focal**2 + y**2 + 0.8 * focal * y

    found = estimate_intrinsics(CAMERA, cost)
    for name in ("fx_px", "cy_px"):
        assert getattr(found.camera, name) == pytest.approx(
            getattr(true, name), abs=2.0 * LEAST_SIGMA * CAMERA.fx_px
        )
    assert found.focal.is_applied
    assert found.principal_y.is_applied
    assert not found.principal_x.is_applied


def test_deviations_are_in_the_units_of_the_numbers():
    found = estimate_intrinsics(CAMERA, Recording(CAMERA))
    # Of both focal lengths, which go together.
    assert found.focal.sigma == pytest.approx(np.hypot(0.002 / np.sqrt(2.0), LEAST_SIGMA))
    assert found.principal_x.sigma == pytest.approx(
        CAMERA.fx_px * np.hypot(0.002, LEAST_SIGMA), rel=1e-6
    )


def test_a_right_calibration_is_the_given_one_and_costs_thirteen_refinements():
    found = estimate_intrinsics(CAMERA, recording := Recording(with_principal_x(CAMERA, 0.2)))
    assert found.camera == CAMERA
    assert not found.focal.is_applied
    assert not found.principal_x.is_applied
    assert len(recording.asked) == 13


def test_one_number_leaves_the_rest_of_a_camera():
    longer = with_focal(CAMERA, 0.02)
    assert (longer.fx_px, longer.fy_px) == (1.02 * CAMERA.fx_px, 1.02 * CAMERA.fy_px)
    assert (longer.cx_px, longer.width) == (CAMERA.cx_px, CAMERA.width)
    aside = with_principal_x(CAMERA, 2.0)
    assert (aside.cx_px, aside.cy_px) == (CAMERA.cx_px + 2.0, CAMERA.cy_px)
    assert aside.fx_px == CAMERA.fx_px
    below = with_principal_y(CAMERA, 2.0)
    assert (below.cx_px, below.cy_px) == (CAMERA.cx_px, CAMERA.cy_px + 2.0)
