"""Bands of Bode curves of a study: the response is the linearised model's, and the band holds what its title says."""

import re

import numpy as np
import pytest
from small_study import batched

import estimators as est
import rtac_jax as rtac
from estimators.plots.study_bode import plot_bode_bands
from estimators.study.truth import FIELD_OF, true_for


@pytest.fixture(scope="module")
def found():
    return est.study(batched(), progress=False)


def response(values: dict[str, float], omega: np.ndarray) -> np.ndarray:
    """Of the package's own linear system, from the torque to the cart's position."""
    model = rtac.RTAC.paper().with_values({name: values[name] for name in FIELD_OF})
    return rtac.linearise(model)["cart_position", "torque"](1j * omega)


def test_the_title_states_the_widest_band_of_the_linearised_models(found):
    figure = plot_bode_bands(found)
    top, middle, _ = figure.get_axes()
    omega, magnitude = (np.asarray(x) for x in top.get_lines()[0].get_data())
    truths = [true_for(found.spec, int(index)).values for index in found.index]
    usual = {name: float(np.median([one[name] for one in truths])) for name in FIELD_OF}
    np.testing.assert_allclose(magnitude, 20 * np.log10(np.abs(response(usual, omega))), atol=1e-6)
    names = found.layout.coordinates["parameter"]
    ratios = []
    for row, truth in enumerate(truths):
        estimated = {n: v for n, v in zip(names, found.arrays["estimate"][row, 0], strict=True) if n in FIELD_OF}
        ratios.append(response(truth | estimated, omega) / response(truth, omega))
    widest = np.max(np.percentile(np.abs(np.array(ratios) - 1), 95, axis=0))
    (said,) = re.findall(r"within ([\d.e-]+) % of the true ones", figure.get_suptitle().replace("\n", " "))
    assert float(said) == pytest.approx(100 * widest, rel=0.05)
    centre = np.asarray(middle.get_lines()[0].get_ydata())
    np.testing.assert_allclose(centre, np.median(20 * np.log10(np.abs(ratios)), axis=0), atol=1e-9)


def test_it_is_among_the_pictures_of_a_study(found):
    assert "bode" in found.figures()
