"""Every picture, on small records made by hand: labels with units, a title that states a finding, nothing empty."""

import dataclasses
import re
import warnings

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from estimators._candidate import Candidate
from estimators._compare import Compared, Comparison, Trace
from estimators._diagnose import Diagnosis
from estimators._force_curve import ForceCurve
from estimators._improve import Improvement
from estimators._output_error import Parameter
from estimators.plots import plot_comparison, plot_diagnosis, plot_improvement, plot_recording, plot_residuals
from estimators.plots._diagnosis import finding
from estimators.plots._style import prefixed, quantity, thin, worst_stretch
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment, Recording

NOISE = {"cart_position": 2e-5, "arm_velocity": 0.05, "arm_angle": 1e-3}
SIZE = {"cart_position": 8e-3, "arm_velocity": 30.0, "arm_angle": 1.5}


def trace(experiment, channel, error, *, samples=600, driven=True, seed=0):
    """A decaying oscillation whose simulation is off by so many times the noise."""
    random = np.random.default_rng([seed, len(experiment), ord(channel[4])])
    time = 0.005 * np.arange(samples)
    truth = SIZE[channel] * np.exp(-0.4 * time) * np.cos(10.4 * time)
    wrong = np.sqrt(2) * error * NOISE[channel] * np.sin(37.4 * time)
    measured = truth + NOISE[channel] * random.standard_normal(samples)
    current = np.sin(9 * time) if driven else np.zeros(samples)
    used = np.arange(samples) >= 0
    return Trace(experiment, channel, time, measured, truth + wrong, current, used, NOISE[channel])


def compared(label, error, *, channels=("cart_position", "arm_velocity"), names=("free_1", "forced_1"), **options):
    traces = [
        trace(name, channel, error / (1 + place), driven=name.startswith("forced"), seed=place, **options)
        for place, name in enumerate(names)
        for channel in channels
    ]
    return Compared(label, RTAC.paper(), tuple(traces), {name: np.zeros(4) for name in names})


def candidate(name, score, **more):
    return Candidate(name, score, float(np.exp(-max(score, 0.0) / 2)), 0.0123, "kg", True, **more)


def curve(port, variable, reach, score=80.0):
    at = np.linspace(-reach, reach, 12)
    return ForceCurve(
        port, variable, score, at, 0.05 * (at / reach) ** 3, np.full(12, 0.004), score + 90.0, score + 78.0, 1e-9,
        np.eye(12)[:3], np.ones(3),
    )  # fmt: skip


CURVES = (
    curve("cart", "cart_position", 0.012),
    curve("cart", "cart_velocity", 0.1, 30.0),
    curve("cart", "arm_angle", np.pi, -5.0),
    curve("arm", "arm_velocity", 40.0, -20.0),
)
OTHERS = tuple(
    candidate(name, -9.0 - i) for i, name in enumerate(("tacho_bias", "cogging", "dead_zone", "current_lag"))
)


def diagnosis(verdict="missing", *, curves=CURVES, others=OTHERS):
    parameters = {"mass": Parameter(0.09, 0.001, "kg")}
    first = candidate(
        "flexible_mode", 1200.0, refitted=True, bic_gain=900.0, error_reduction=1.0, parameters=parameters
    )
    second = candidate("cubic_spring", 1100.0, refitted=True, bic_gain=895.0, error_reduction=0.97)
    effects = {"missing": (first,), "ambiguous": (first, second)}.get(verdict, ())
    return Diagnosis(
        verdict, effects, (), (*effects, *others), (), (), 1.0, curves, (), (), (), 0.1, 0.1, "In plain words.", 1.0
    )


def improvement(steps=2):
    labels = ["base", "+ flexible_mode", "+ flexible_mode, cogging"][:steps]
    errors = [30.0, 3.0, 0.3][:steps]
    models = tuple(compared(label, error) for label, error in zip(labels, errors, strict=True))
    found = diagnosis()
    return Improvement(
        (), (found,), found.effects[: steps - 1] + OTHERS[1 : steps - 1], "missing" if steps > 1 else "adequate",
        Comparison(models), Comparison(models), "Stopped.", 1.0,
    )  # fmt: skip


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
    "unknown": lambda: plot_diagnosis(diagnosis("unknown", curves=CURVES[:2])),
    "improvement": lambda: plot_improvement(improvement()),
    "improvement in two steps": lambda: plot_improvement(improvement(3)),
    "improvement of nothing": lambda: plot_improvement(improvement(1)),
    "recording": lambda: plot_recording(recording()),
}


@pytest.fixture(scope="module")
def drawn():
    """Every picture once, drawn to the end: layout problems warn only then, and warnings are errors."""
    before = dict(matplotlib.rcParams)
    found = {name: draw() for name, draw in PICTURES.items()}
    for figure in found.values():
        figure.canvas.draw()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # reading some rcParams warns
        assert dict(matplotlib.rcParams) == before
    return found


@pytest.mark.parametrize("name", PICTURES)
def test_every_picture_is_labelled_and_states_a_finding(drawn, name):
    figure = drawn[name]
    assert isinstance(figure, Figure)
    assert len(figure.get_suptitle()) > 20
    axes = figure.get_axes()
    assert axes
    for one in axes:
        assert one.lines or one.patches or one.collections or one.texts, "empty axes"
    labels = [text for one in axes for text in (one.get_xlabel(), one.get_ylabel()) if text]
    assert labels
    assert all(re.search(r"\[[^\]]+\]", text.replace("\n", " ")) for text in labels), labels


@pytest.mark.parametrize("name", PICTURES)
def test_nothing_sticks_out_of_a_picture(drawn, name):
    figure = drawn[name]
    width = figure.bbox.width
    for text in [figure._suptitle, *(one.title for one in figure.get_axes())]:
        box = text.get_window_extent()
        assert box.x0 >= 0, text.get_text()
        assert box.x1 <= width, text.get_text()


def test_titles_carry_the_numbers(drawn):
    assert "flexible_mode explains 100 % of the misfit; nothing else comes near" in drawn["diagnosis"].get_suptitle()
    assert "cannot tell it from cubic_spring" in drawn["ambiguous"].get_suptitle().replace("\n", " ")
    assert "falls from" in drawn["comparison of two"].get_suptitle().replace("\n", " ")
    assert "37 rad/s" in drawn["residuals"].get_suptitle().replace("\n", " ")
    assert "worst 2 of 2" in drawn["comparison of one"].get_suptitle().replace("\n", " ")
    assert "4 of 7" in drawn["recording"].get_suptitle().replace("\n", " ")


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
