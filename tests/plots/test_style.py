"""What every picture shares: titles, units, files that do not change, long records made short."""

import numpy as np
import pytest
from made_up_results import compared

from estimators.plots import plot_bands
from estimators.plots.style import image_bytes, picture, prefixed, quantity, thin, title, worst_stretch
from estimators.validation.simulation_error import Comparison


def test_a_figure_is_the_same_in_both_formats_and_twice():
    figure = plot_bands(Comparison((compared("model", 12.0),)))
    first = image_bytes(figure, "png")
    assert image_bytes(figure, "svg").startswith(b"<?xml")
    assert image_bytes(figure, "png") == first


def test_a_title_does_not_end_in_a_line_of_one_word():
    figure = picture(9.6, 3.0)
    title(
        figure,
        "The model with flexible_mode leaves nothing but noise: the worst, arm velocity in forced_2, is 1.04 times it",
    )
    lines = figure.get_suptitle().split("\n")
    assert len(lines) == 2
    assert len(lines[1]) > 0.6 * len(lines[0])


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.0123, "kg", "12 g"),
        (57_000.0, "N/m^3", "57 kN/m³"),
        (1.3e-4, "rad", "130 µrad"),
        (0.05, "1", "0.05"),
        (0.0025, "1/A", "0.0025 1/A"),
        (0.0, "m", "0 m"),
    ],
)
def test_quantities_read_well(value, unit, text):
    assert quantity(value, unit) == text


def test_prefixes_bring_numbers_near_one():
    assert prefixed(0.015, "m") == (1e3, "mm")
    assert prefixed(45.0, "rad/s") == (1.0, "rad/s")
    assert prefixed(6.4e-6, "s^2") == (1.0, "s^2"), "a prefix would be squared, too"
    assert prefixed(9.5e-5, "N m s^2") == (1e6, "µN m s^2")
    assert prefixed(float("nan"), "m") == (1.0, "m")


def test_thinning_keeps_every_peak():
    time = np.arange(100_000.0)
    values = np.zeros(100_000)
    values[[777, 50_001]] = 5.0, -7.0
    values[30_000:40_000] = np.nan
    shorter, kept = thin(time, values)
    assert len(kept) < 4000
    assert np.all(np.diff(shorter) >= 0)
    assert (np.nanmax(kept), np.nanmin(kept)) == (5.0, -7.0)


def test_the_worst_stretch_holds_the_largest_residual():
    residual = np.zeros(20_000)
    residual[12_345] = 1.0
    near = worst_stretch(residual)
    assert near.start <= 12_345 < near.stop
    assert worst_stretch(residual[:100]) == slice(0, 100)


def test_a_title_of_a_wide_picture_keeps_its_middle():
    figure, said = picture(14.0, 3.0), " ".join(["a finding of many words that fit into one line"] * 3)[:135]
    title(figure, said)
    image_bytes(figure, "png")
    assert " ".join(figure.get_suptitle().split()) == said
