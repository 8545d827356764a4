"""Every picture on small records made by hand: units, a title that states a finding, nothing empty."""

import dataclasses
import itertools
import re
import warnings

import matplotlib
import numpy as np
import pytest
from made_up_results import (
    ARM_CURVES,
    CURVES,
    FORESEEN,
    NOISE,
    OTHERS,
    alike,
    candidate,
    compared,
    diagnosis,
    improvement,
    latent,
)
from matplotlib.figure import Figure
from scipy.signal import lfilter

from estimators._compare import Compared, Comparison, Trace
from estimators._force_curve import ForceCurve
from estimators.plots import (
    plot_bands,
    plot_comparison,
    plot_confusion,
    plot_diagnosis,
    plot_improvement,
    plot_recording,
    plot_residuals,
)
from estimators.plots._bands import band_errors
from estimators.plots._confusion import confusable
from estimators.plots._diagnosis import finding
from estimators.plots._effect_curve import effect_curve
from estimators.plots._style import image_bytes, picture, prefixed, quantity, thin, title, worst_stretch
from rtac_jax import RTAC
from rtac_jax.effects import (
    CartStribeck,
    Cogging,
    CubicSpring,
    Effect,
    FlexibleMode,
    GravityTilt,
    QuadraticSpring,
)
from rtac_jax.measurement import Experiment, Recording


def recording():
    time = 0.005 * np.arange(3000)
    wave = np.sin(10 * time)
    free = Experiment.of("free_1", kind="free", sample_time=0.005, cart_position=0.01 * wave, arm_velocity=wave)
    forced = Experiment.of(
        "forced_1",
        kind="forced",
        sample_time=0.005,
        current=0.2 * wave,
        cart_position=0.008 * wave,
        arm_velocity=9 * wave,
    )
    more = [dataclasses.replace(forced, name=f"forced_{n}") for n in range(2, 6)]
    rest = Experiment.of("rest_1", kind="rest", sample_time=0.005, cart_position=1e-5 * wave)
    return Recording((free, forced, *more, rest))


PICTURES = {
    "comparison of one": lambda: plot_comparison(Comparison((compared("model", 12.0),))),
    "comparison of two": lambda: plot_comparison(Comparison((compared("base", 12.0), compared("+ mode", 0.2)))),
    "comparison of six": lambda: plot_comparison(Comparison(tuple(compared(f"m{n}", 9.0 / n) for n in range(1, 7)))),
    "comparison of three channels": lambda: plot_comparison(
        Comparison((compared("model", 3.0, channels=tuple(NOISE)),))
    ),
    "comparison of a long one": lambda: plot_comparison(Comparison((compared("model", 3.0, samples=30_000),))),
    "residuals": lambda: plot_residuals(compared("base", 12.0)),
    "residuals without input": lambda: plot_residuals(compared("base", 0.1, names=("free_1",))),
    "residuals of many": lambda: plot_residuals(compared("base", 90.0, names=tuple(f"forced_{n}" for n in range(30)))),
    "diagnosis": lambda: plot_diagnosis(diagnosis()),
    "ambiguous": lambda: plot_diagnosis(diagnosis("ambiguous")),
    "adequate": lambda: plot_diagnosis(diagnosis("adequate", curves=())),
    "unknown": lambda: plot_diagnosis(diagnosis("unknown", curves=CURVES[:2]), recording=recording()),
    "unknown on the arm": lambda: plot_diagnosis(
        diagnosis("unknown", curves=ARM_CURVES, missing=latent("arm")), recording=recording()
    ),
    "a force in the arm's velocity": lambda: plot_diagnosis(diagnosis(curves=ARM_CURVES)),
    "a locked arm": lambda: plot_diagnosis(diagnosis(curves=CURVES[:2])),
    "unknown without a recording": lambda: plot_diagnosis(diagnosis("unknown", curves=())),
    "a static force": lambda: plot_diagnosis(diagnosis(additions=(CubicSpring(-29_000.0),))),
    "forty candidates": lambda: plot_diagnosis(
        diagnosis(others=tuple(candidate(f"effect_number_{n}", 30.0 - n) for n in range(39)))
    ),
    "confusion": lambda: plot_confusion(diagnosis(others=alike(15, 0.95))),
    "confusion of few": lambda: plot_confusion(diagnosis("adequate", others=OTHERS)),
    "confusion of one": lambda: plot_confusion(diagnosis(others=())),
    "bands of one": lambda: plot_bands(Comparison((compared("model", 12.0),))),
    "bands of two": lambda: plot_bands(Comparison((compared("base", 12.0), compared("+ mode", 0.2)))),
    "improvement": lambda: plot_improvement(improvement()),
    "improvement in two steps": lambda: plot_improvement(improvement(3)),
    "improvement of predictions": lambda: plot_improvement(improvement(errors=(3.0, 3.1), foreseen=(FORESEEN,))),
    "improvement of nothing": lambda: plot_improvement(improvement(1)),
    "recording": lambda: plot_recording(recording()),
}


@pytest.fixture(scope="module")
def drawn():
    """Every picture once, drawn to the end: layout problems warn only then, and warnings are errors."""
    before = dict(matplotlib.rcParams)
    found = {name: draw() for name, draw in PICTURES.items()}
    for figure in found.values():
        figure.draw_without_rendering()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # reading some rcParams warns
        assert dict(matplotlib.rcParams) == before
    return found


def test_where_a_simulation_does_not_tell_the_title_says_what_predictions_do(drawn):
    stated = drawn["improvement of predictions"].get_suptitle().replace("\n", " ")
    assert "cart position is foreseen one sample ahead better, from 1.60 to 1.10 times the noise" in stated


@pytest.mark.parametrize("name", PICTURES)
def test_every_picture_is_labelled_and_states_a_finding(drawn, name):
    figure = drawn[name]
    assert isinstance(figure, Figure)
    assert len(figure.get_suptitle()) > 20
    axes = figure.get_axes()
    assert axes
    for one in axes:
        assert one.lines or one.patches or one.collections or one.texts or one.images, "empty axes"
    labels = [text for one in axes for text in (one.get_xlabel(), one.get_ylabel()) if text]
    assert labels
    assert all(re.search(r"\[[^\]]+\]", text.replace("\n", " ")) for text in labels), labels


@pytest.mark.parametrize("name", PICTURES)
def test_titles_neither_stick_out_of_a_picture_nor_overlap(drawn, name):
    figure = drawn[name]
    width = figure.bbox.width
    every = [figure._suptitle, *(text for one in figure.get_axes() for text in (one.title, one._left_title))]
    titles = [text for text in every if text.get_text()]
    boxes = [text.get_window_extent().padded(-2.0) for text in titles]  # lines of text are higher than their letters
    for text, box in zip(titles, boxes, strict=True):
        assert box.x0 >= 0, text.get_text()
        assert box.x1 <= width, text.get_text()
    for i, j in itertools.combinations(range(len(titles)), 2):
        assert not boxes[i].overlaps(boxes[j]), (titles[i].get_text(), titles[j].get_text())


def test_titles_carry_the_numbers(drawn):
    assert "flexible_mode explains 100 % of the misfit; nothing else comes near" in drawn["diagnosis"].get_suptitle()
    assert "cannot tell it from cubic_spring" in drawn["ambiguous"].get_suptitle().replace("\n", " ")
    assert "falls from" in drawn["comparison of two"].get_suptitle().replace("\n", " ")
    assert "37 rad/s" in drawn["residuals"].get_suptitle().replace("\n", " ")
    assert "worst 2 of 2" in drawn["comparison of one"].get_suptitle().replace("\n", " ")
    assert "4 of 7" in drawn["recording"].get_suptitle().replace("\n", " ")


def test_titles_of_the_new_pictures_carry_their_numbers(drawn):
    assert "falls from" in drawn["bands of two"].get_suptitle().replace("\n", " ")
    # 37.4 rad/s are 5.95 Hz
    low, high = map(
        float,
        re.findall(r"between ([\d.]+) and ([\d.]+) Hz", drawn["bands of one"].get_suptitle().replace("\n", " "))[0],
    )
    assert low < 37.4 / (2 * np.pi) < high
    assert "best 14 candidates, 26 more score lower" in drawn["forty candidates"].get_axes()[0].get_title(loc="left")
    assert len(drawn["forty candidates"].get_axes()[0].get_yticks()) == 14


def test_the_error_in_a_band_is_counted_in_noise():
    """White noise is one times the noise in every band; a sine of that power is one band's alone."""
    time = 0.005 * np.arange(4000)
    noise = 2e-5 * np.random.default_rng(0).standard_normal(4000)
    sine = np.sqrt(2) * 2e-5 * np.sin(2 * np.pi * 10 * time)
    edges = np.array([1.0, 9.0, 11.0, 100.0])
    found = []
    for wrong in (0 * sine, sine):
        measured = noise + wrong
        one = Trace("a", "cart_position", time, measured, 0 * time, 0 * time, time >= 0, 2e-5)
        found.append(band_errors(Compared("model", RTAC.paper(), (one,), {}), "cart_position", edges))
    np.testing.assert_allclose(found[0], 1.0, atol=0.1)
    # All of the sine's power, 1 in units of the noise over 100 Hz, lies in 2 Hz, beside 1/50 of the noise.
    np.testing.assert_allclose(found[1], [1.0, np.sqrt(51.0), 1.0], rtol=0.1)


def coloured(kind, samples, seed):
    """Noise with the colour of a drifting sensor, or of a lightly damped mode at 37.4 rad/s."""
    white = np.random.default_rng(seed).standard_normal(samples + 2000)
    radius = np.exp(-0.03 * 37.4 * 0.005)
    poles = {"drift": [1, -0.95], "mode": [1, -2 * radius * np.cos(37.4 * 0.005), radius**2]}[kind]
    return lfilter([1.0], poles, white)[2000:]


def correlated(residual, current):
    at = 0.005 * np.arange(len(residual))
    one = Trace("a", "cart_position", at, residual, 0 * at, current, at >= 0, 1.0)
    return one.cross_correlation(50)


@pytest.mark.parametrize(("residual", "current"), [("drift", "drift"), ("mode", "drift"), ("drift", "mode")])
def test_one_in_a_hundred_correlations_with_an_independent_input_is_outside_its_band(residual, current):
    """Coloured on both sides, where a band for white noise leaves tens of percent outside."""
    outside, outside_white = [], []
    for seed in range(150):
        found, band = correlated(coloured(residual, 4000, (seed, 0)), coloured(current, 4000, (seed, 1)))
        outside.append(np.mean(np.abs(found) > band))
        outside_white.append(np.mean(np.abs(found) > 2.58 / np.sqrt(4000)))
    assert 0.002 < np.mean(outside) < 0.03
    assert np.mean(outside_white) > 0.1


def test_an_input_that_acts_late_shows_at_its_lag():
    current = np.random.default_rng(0).standard_normal(4000)
    late = np.concatenate([np.zeros(7), current[:-7]])
    found, band = correlated(coloured("drift", 4000, 1) + late, current)
    assert np.argmax(found) == 7
    assert found[7] > 2 * band
    assert np.sum(np.abs(found) > band) < 6
    # Half of the residual missing: what is left still shows it.
    gaps = np.where(np.arange(4000) % 400 < 200, coloured("drift", 4000, 1) + late, np.nan)
    found, band = correlated(gaps, current)
    assert np.argmax(found) == 7
    assert found[7] > band


def test_an_input_that_stands_still_correlates_with_nothing():
    found, band = correlated(coloured("drift", 400, 0), np.ones(400))
    assert not np.any(found)
    assert band == pytest.approx(2.576 / 20, rel=1e-3)


def test_a_fitted_static_force_lies_on_the_curve_that_it_made():
    """The curve of a cubic spring without the slope that the linear spring takes up, however much that is."""
    at = np.linspace(-0.012, 0.012, 12)
    for slope in (0.0, 3.0):
        shown = dataclasses.replace(CURVES[0], at=at, force=-29_000.0 * at**3 + slope * at, std=np.full(12, 1e-3))
        found = effect_curve(CubicSpring(29_000.0), shown)
        assert found is not None
        np.testing.assert_allclose(np.interp(at, *found), shown.force, atol=2e-4)


def test_dry_friction_has_a_sign():
    speeds = np.linspace(-0.1, 0.1, 12)
    level = 0.05 * np.exp(-((speeds / 0.02) ** 2))
    shown = dataclasses.replace(CURVES[1], at=speeds, force=-level * np.sign(speeds), std=np.full(12, 1e-3))
    found = effect_curve(CartStribeck(0.05, 0.02), shown)
    assert found is not None
    np.testing.assert_allclose(found[1][found[0] > 0.05], 0.0, atol=2e-3)
    assert found[1][found[0] < 0].max() > 0.02 > -0.02 > found[1][found[0] > 0].min()


@pytest.mark.parametrize(
    ("effect", "curve"),
    [
        (Cogging(1e-3, 0.0, 3.0), CURVES[0]),  # depends on the arm's angle, not on this variable
        (CubicSpring(1e4), CURVES[1]),
        (CubicSpring(1e4), CURVES[3]),  # on the other port
        (FlexibleMode(0.1, 37.4, 0.03), CURVES[0]),  # has states of its own
        (GravityTilt(0.01, 0.01), CURVES[0]),  # needs the mass of the body
    ],
)
def test_only_a_static_force_in_the_variable_is_drawn(effect: Effect, curve: ForceCurve):
    assert effect_curve(effect, curve) is None


@pytest.mark.parametrize(
    ("name", "port", "variables"),
    [
        ("diagnosis", "cart", ["Cart position", "Cart velocity", "Arm angle"]),
        ("ambiguous", "cart", ["Cart position", "Cart velocity", "Arm angle"]),
        ("a locked arm", "cart", ["Cart position", "Cart velocity"]),
        ("a force in the arm's velocity", "arm", ["Arm velocity", "Cart position", "Cart velocity", "Arm angle"]),
        ("unknown on the arm", "arm", ["Time", "Arm velocity", "Cart position", "Cart velocity", "Arm angle"]),
        ("unknown", "cart", ["Time", "Cart position", "Cart velocity"]),
    ],
)
def test_the_missing_force_is_drawn_against_position_velocity_and_angle(drawn, name, port, variables):
    panels = drawn[name].get_axes()[1:]
    assert [re.sub(r" \[.*", "", panel.get_xlabel()) for panel in panels] == variables
    assert all(f"on the {port} [" in panel.get_ylabel() for panel in panels)
    curves = [panel for panel in panels if not panel.get_xlabel().startswith("Time")]
    assert len({panel.get_ylim() for panel in curves}) == 1, "curves on different scales cannot be compared"


def test_a_force_that_depends_on_nothing_is_drawn_where_it_acts():
    """The best of the curves says nothing then; the force in time, or the effect that was named, says the port."""
    nothing = tuple(dataclasses.replace(c, score=-1.0 - n, p_value=0.5) for n, c in enumerate((*CURVES, *ARM_CURVES)))
    unknown = diagnosis("unknown", curves=nothing, missing=latent("arm"))
    assert "missing on the arm is no function of position, velocity or angle" in finding(unknown)
    named = diagnosis(curves=nothing, additions=(Cogging(1e-3, 0.0, 3.0),))
    for found in (unknown, named):
        panels = plot_diagnosis(found).get_axes()[-3:]
        assert [panel.get_ylabel() for panel in panels] == ["Torque on the arm [mN m]"] * 3
    assert plot_diagnosis(diagnosis(curves=nothing)).get_axes()[-1].get_ylabel() == "Force on the cart [mN]"


def test_the_latent_force_is_drawn_for_the_experiment_that_carries_most(drawn):
    panel = next(a for a in drawn["unknown"].get_axes() if "forced_1" in a.get_title(loc="left"))
    assert panel.get_xlabel() == "Time [s]"
    x, y = panel.lines[0].get_data()
    assert len(x) == 600
    assert x[-1] == pytest.approx(599 * 0.005)
    assert np.max(np.abs(y)) == pytest.approx(50.0, rel=1e-3)  # mN
    assert any("Sample" in a.get_xlabel() for a in drawn["unknown without a recording"].get_axes())


def test_what_looks_alike_is_named(drawn):
    assert "effect_1 looks much like flexible_mode" in drawn["confusion"].get_suptitle().replace("\n", " ")
    assert len(drawn["confusion"].get_axes()[0].get_xticks()) == 12
    untestable = dataclasses.replace(candidate("no_way", 60.0), testable=False)
    assert [c.id for c in confusable(diagnosis(others=(untestable, *alike(3, 0.2))))] == [
        "flexible_mode", "effect_0", "effect_1", "effect_2",
    ]  # fmt: skip


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


def test_all_that_was_named_stands_in_the_title():
    two = diagnosis(others=())
    second = candidate("cubic_spring", 300.0, refitted=True, bic_gain=295.0, error_reduction=0.2)
    both = dataclasses.replace(two, effects=(*two.effects, second), candidates=(*two.effects, second), removed=0.98)
    assert finding(both) == "flexible_mode and cubic_spring together explain 98 % of the misfit"
    third = dataclasses.replace(second, id="input_delay", confusable_with=("current_lag",))
    rival = dataclasses.replace(second, id="current_lag", confusable_with=("input_delay",))
    open_pair = dataclasses.replace(both, verdict="ambiguous", effects=(*two.effects, third, rival))
    assert finding(open_pair).startswith("flexible_mode and (current_lag or input_delay) together explain 98 %")


def test_a_narrow_curve_is_no_less_a_static_force():
    """Of which the price of all its points is more than it explains, though chance never explains so much."""
    best = dataclasses.replace(CURVES[0], score=-5.0)
    unknown = diagnosis("unknown", curves=(best, *CURVES[2:]))
    assert finding(unknown).endswith("what is missing on the cart depends most on cart position")
    told = [axes.get_title(loc="left") for axes in plot_diagnosis(unknown).get_axes()]
    assert any(title.startswith("against cart position:\nexplains") for title in told)
    assert any(title.startswith("against arm angle:\nnothing beyond chance") for title in told)
    small = dataclasses.replace(unknown, tests=(*unknown.tests, dataclasses.replace(unknown.tests[0], excess=900.0)))
    assert "is for the most part no function of position" in finding(small)


def test_every_effect_that_was_added_is_drawn_over_the_missing_force():
    figure = plot_diagnosis(diagnosis(additions=(CubicSpring(5e4), QuadraticSpring(600.0))))
    panel = next(a for a in figure.get_axes() if a.get_title(loc="left").startswith("against cart position"))
    assert [line.get_label() for line in panel.lines if "fitted" in str(line.get_label())] == [
        "cubic_spring, fitted",
        "quadratic_spring, fitted",
    ]


def test_a_rival_is_named():
    rival = candidate("cubic_spring", 400.0, refitted=True, bic_gain=300.0, error_reduction=0.4)
    assert finding(diagnosis(others=(rival, *OTHERS))).endswith("the next, cubic_spring, 40 %")


def test_a_notebook_can_show_a_figure(drawn):
    assert drawn["recording"]._repr_png_().startswith(b"\x89PNG")


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


def test_a_bar_beyond_the_line_that_is_no_alarm_says_so():
    scattered = dataclasses.replace(candidate("lvdt_gain", 60.0), p_value=0.1)
    figure = plot_diagnosis(
        diagnosis("adequate", others=(scattered, candidate("tacho_gain", 90.0), *OTHERS), additions=())
    )
    texts = [t.get_text() for axes in figure.axes for t in axes.texts]
    assert "no alarm: by its scatter p = 0.1" in texts
    bars = {b.get_width(): b.get_hatch() for b in figure.axes[0].patches}
    assert not bars[scattered.chi_square]
    assert bars[candidate("tacho_gain", 90.0).chi_square] == "///"
