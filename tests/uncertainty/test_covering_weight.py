"""A weight between the points of its grid, against plants evaluated by python-control at points a hundred times as close."""

import control as ct
import numpy as np
import pytest

import estimators as est


@pytest.mark.parametrize("damping", [pytest.param(0.02, marks=pytest.mark.slow), 0.001])
def test_a_weight_covers_peaks_that_are_narrower_than_the_grid(damping):
    """Between points of a grid of 40 over four decades a mode of this damping is not seen."""
    places = (9.7, 10.0, 10.3)
    plants = [ct.tf([place**2], [1.0, 2 * damping * place, place**2]) for place in places]
    covering = est.envelope(
        plants, omega=np.geomspace(0.1, 1000, 40), order_nominal=2, order_weight=4, within_db=200.0, progress=False
    )
    near = np.linspace(-10, 10, 4001) * damping
    nominal = np.abs(np.concatenate([covering.nominal.poles(), covering.nominal.zeros()]).imag)
    omega = np.unique(np.concatenate([place * (1 + near) for place in (*places, *nominal[nominal > 1])]))
    omega = omega[(omega > 0.1) & (omega < 1000)]
    model = covering.nominal_response(omega)
    weight = covering.weight_magnitude(omega)
    worst = max(np.max(np.abs(plant(1j * omega) / model - 1) / weight) for plant in plants)
    assert 0.9 < worst < 1.0 + 1e-4


def test_a_plant_that_is_outside_between_the_frequencies_only_is_not_covered() -> None:
    """A lightly damped mode that falls between two frequencies of the envelope, against a grid of 200,000."""
    plants = [ct.tf([place**2], [1.0, 0.2 * place, place**2]) for place in (9.5, 10.0, 10.5)]
    covering = est.envelope(
        plants, omega=np.geomspace(1, 100, 60), kind="additive", order_nominal=2, within_db=30.0, progress=False
    )
    between = float(np.sqrt(covering.frequency[29] * covering.frequency[30]))
    size = 0.002 * between * float(covering.weight_magnitude(np.array([between]))[0])
    fresh = [
        plants[1] + ct.tf([2 * times * size, 0.0], [1.0, 2 * 0.002 * between, between**2])
        for times in (0.0, 0.5, 2.0, 4.0)
    ]
    omega = np.unique(np.append(np.geomspace(1, 100, 100_000), between * (1 + np.linspace(-0.05, 0.05, 100_000))))
    nominal, weight = covering.nominal_response(omega), covering.weight_magnitude(omega)
    truth = np.array([np.max(np.abs(plant(1j * omega) - nominal) / weight) for plant in fresh])
    np.testing.assert_allclose(covering.distance(fresh, covering.frequency), truth, rtol=1e-3)
    only = np.abs([plant(1j * covering.frequency) - covering.nominal_response() for plant in fresh])
    assert np.any((np.max(only / covering.weight_magnitude(), axis=1) < 1) & (truth > 1))
