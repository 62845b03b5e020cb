import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline

from roel_service.geometry.smoothing_spline import smoothing_spline

RNG = np.random.default_rng(0)
X = np.cumsum(RNG.uniform(0.5, 1.5, 40))
Y = np.stack([np.sin(X / 6.0), X / 50.0], axis=1) + RNG.normal(0.0, 0.05, (40, 2))


@pytest.mark.parametrize("stiffness", [1e-4, 1.0, 1e3])
def test_it_is_the_spline_of_the_library(stiffness):
    at = np.linspace(X[0], X[-1], 200)
    expected = make_smoothing_spline(X, Y, lam=stiffness)(at)
    np.testing.assert_allclose(smoothing_spline(X, Y, stiffness)(at), expected, atol=1e-9)


def test_without_stiffness_it_interpolates():
    np.testing.assert_allclose(smoothing_spline(X, Y, 0.0)(X), Y, atol=1e-12)


def test_with_much_of_it_the_curve_is_a_line():
    fitted = np.polynomial.polynomial.polyfit(X, Y, 1)
    line = np.polynomial.polynomial.polyval(X, fitted).T
    np.testing.assert_allclose(smoothing_spline(X, Y, 1e10)(X), line, atol=1e-5)


def test_four_points_are_enough():
    x = np.arange(4.0)
    np.testing.assert_allclose(smoothing_spline(x, x[:, None], 1.0)(1.5), [1.5])
