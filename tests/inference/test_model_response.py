"""Response, poles and zeros of a fitted model with their uncertainty, against draws from the covariance."""

import dataclasses

import numpy as np
import pytest

from estimators.core.fisher_information import Information
from estimators.core.fit import Fit
from estimators.core.results import RESULTS
from estimators.frequency_response.response import FrequencyResponses
from estimators.inference.model_response import model_response, model_roots
from estimators.plots import plot_bode, plot_correlations, plot_poles_zeros
from rtac_jax import RTAC
from rtac_jax.effects import InputDelay

MODEL = RTAC.paper()
VALUES = {name: float(MODEL[name]) for name in MODEL.parameters}
NAMES = ("spring_stiffness", "eccentric_moment", "cart_viscous.coefficient")
STD = np.array([0.8, 1e-5, 0.02])
MATRIX = np.array([[1.0, 0.95, 0.0], [0.95, 1.0, -0.3], [0.0, -0.3, 1.0]])
OMEGA = np.array([4.0, 10.0, 10.4, 11.0, 20.0])


@pytest.fixture(scope="module")
def fit():
    covariance = MATRIX * np.outer(STD, STD)
    known = Information(NAMES, covariance, np.eye(3), np.ones(3))
    noise = {"cart_position": 2e-5}
    return Fit(MODEL, RESULTS.successful, known, noise, noise, {}, ("a",), {"starts": 1, "agreed": 1})


def response(values, omega):
    """Equations (1) and (2) at small motions, in plain NumPy."""
    m, j, e, k, kt, v, dp, dn = (
        values.get(name, VALUES[name]) for name in (
            "total_mass", "arm_inertia", "eccentric_moment", "spring_stiffness", "torque_constant",
            "cart_viscous.coefficient", "arm_viscous.positive", "arm_viscous.negative",
        )
    )  # fmt: skip
    s = 1j * omega
    arm, cart, push = j * s**2 + 0.5 * (dp + dn) * s, m * s**2 + v * s + k, e * s**2
    return -push * kt / (cart * arm - push**2)


def test_the_response_has_the_spread_of_draws_from_the_covariance(fit):
    found = model_response(fit, OMEGA)
    np.testing.assert_allclose(found.response, response({}, OMEGA), rtol=1e-9)
    centre = np.array([VALUES[name] for name in NAMES])
    # Small enough to be linear: the covariance of a hundredth of the deviations.
    draws = np.random.default_rng(1).multivariate_normal(np.zeros(3), MATRIX, 4000) * STD * 1e-2
    several = np.array([response(dict(zip(NAMES, centre + d, strict=True)), OMEGA) for d in draws])
    spread = 100 * np.sqrt(np.mean(np.abs(several - response({}, OMEGA)) ** 2, axis=0))
    np.testing.assert_allclose(found.std, spread, rtol=0.05)
    turned = model_response(fit, OMEGA, arm_angle=np.pi)
    np.testing.assert_allclose(
        turned.response, found.response, rtol=1e-9
    )  # Fig. 3 takes the sign of cos(theta) into the input
    with pytest.raises(ValueError, match="does not push"):
        model_response(fit, OMEGA, arm_angle=np.pi / 2)


def test_poles_are_those_of_the_response_with_the_spread_of_draws(fit):
    poles, zeros = model_roots(fit)
    assert not np.any(np.abs(poles.values) < 1e-6)  # the arm's own angle cancels
    s = poles.values[np.argmax(poles.values.imag)]

    def mode(values):
        m, j, e, k, v = (values.get(n, VALUES[n]) for n in (
            "total_mass", "arm_inertia", "eccentric_moment", "spring_stiffness", "cart_viscous.coefficient"))  # fmt: skip
        drag = 0.5 * (VALUES["arm_viscous.positive"] + VALUES["arm_viscous.negative"])
        roots = np.roots([m * j - e**2, m * drag + v * j, k * j + v * drag, k * drag])
        return roots[np.argmax(roots.imag)]

    assert s == pytest.approx(mode({}), rel=1e-9)
    centre = np.array([VALUES[name] for name in NAMES])
    draws = np.random.default_rng(2).multivariate_normal(np.zeros(3), MATRIX, 4000) * STD * 1e-2
    moved = 100 * (np.array([mode(dict(zip(NAMES, centre + d, strict=True))) for d in draws]) - mode({}))
    covariance = poles.covariance[np.argmax(poles.values.imag)]
    np.testing.assert_allclose(np.sqrt(np.diagonal(covariance)), [np.std(moved.real), np.std(moved.imag)], rtol=0.05)
    assert len(zeros.values) < len(poles.values)


def test_correlations_and_ellipses_are_those_of_the_covariance(fit):
    found = fit.correlations()
    np.testing.assert_allclose(found.matrix, MATRIX, atol=1e-12)
    assert found.strongest()[:2] == NAMES[:2]
    assert "spring_stiffness and eccentric_moment are correlated by 0.950" in str(found)
    x, y = found.ellipse(NAMES[0], NAMES[1]) - found.values[:2, None]
    inverse = np.linalg.inv(found.covariance[:2, :2])
    distance = np.einsum("ip,ij,jp->p", np.stack([x, y]), inverse, np.stack([x, y]))
    np.testing.assert_allclose(distance, 4.0, rtol=1e-6)
    assert np.max(x) == pytest.approx(2 * STD[0], rel=2e-3)
    with pytest.raises(ValueError, match="not among the free"):
        found.ellipse("nothing", NAMES[0])


def test_pictures_state_what_they_show(fit):
    measured = dataclasses.replace(model_response(fit, np.geomspace(5, 25, 30)), name="condition_1", freedom=20)
    pictures = {
        "correlations": plot_correlations(fit.correlations()),
        "bode": plot_bode(fit, FrequencyResponses((measured,))),
        "poles": plot_poles_zeros(fit),
    }
    titles = {name: " ".join(figure.get_suptitle().split()) for name, figure in pictures.items()}
    assert "correlated by 0.950" in titles["correlations"]
    assert "100 % of the measured magnitudes" in titles["bode"]
    assert "at 10.4 rad/s" in titles["bode"]
    assert "every mode is damped" in titles["poles"]
    near = pictures["poles"].axes[1]  # the mode, whose ellipse would be a line beside the real pole far off
    assert near.get_aspect() == 1.0
    assert near.get_xlim()[1] == -near.get_xlim()[0] == near.get_ylim()[1]
    assert fit.correlations().plot().get_suptitle() == pictures["correlations"].get_suptitle()
    for name, figure in pictures.items():
        figure.draw_without_rendering()
        assert all("[" in axes.get_xlabel() for axes in figure.get_axes() if axes.get_xlabel()), name


def test_a_dead_time_turns_the_response_exactly_and_moves_no_pole(fit):
    late = dataclasses.replace(fit, model=MODEL + InputDelay(0.01))
    turned = response({}, OMEGA) * np.exp(-1j * OMEGA * 0.01)
    np.testing.assert_allclose(model_response(late, OMEGA).response, turned, rtol=1e-9)
    np.testing.assert_allclose(model_roots(late)[0].values, model_roots(fit)[0].values, rtol=1e-9)
