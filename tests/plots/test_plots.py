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
    LEARNED,
    NOISE,
    OTHERS,
    PREDICTED,
    alike,
    candidate,
    compared,
    curve,
    diagnosis,
    improvement,
    latent,
    places,
)
from matplotlib.figure import Figure

from estimators.plots import (
    plot_bands,
    plot_comparison,
    plot_confusion,
    plot_diagnosis,
    plot_improvement,
    plot_learned_force,
    plot_recording,
    plot_residuals,
    plot_where,
)
from estimators.plots.bands import band_errors
from estimators.plots.confusion import confusable
from estimators.plots.diagnosis import _reach, finding
from estimators.plots.style import title
from estimators.validation.simulation_error import Compared, Comparison, Trace
from rtac_jax import RTAC
from rtac_jax.effects import (
    Cogging,
    CubicSpring,
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


def learned(**changes):
    """An improvement whose last model has a learned force."""
    return dataclasses.replace(improvement(2, "unknown"), learned=dataclasses.replace(LEARNED, **changes))


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
    "confusion of none": lambda: plot_confusion(dataclasses.replace(diagnosis("unknown"), effects=(), candidates=())),
    "bands of one": lambda: plot_bands(Comparison((compared("model", 12.0),))),
    "bands of two": lambda: plot_bands(Comparison((compared("base", 12.0), compared("+ mode", 0.2)))),
    "bands of coloured noise": lambda: plot_bands(
        Comparison((compared("model", 12.0),)), coloured=("cart_position", "arm_velocity")
    ),
    "improvement": lambda: plot_improvement(improvement()),
    "improvement in two steps": lambda: plot_improvement(improvement(3)),
    "improvement of predictions": lambda: plot_improvement(
        improvement(errors=(3.0, 3.1), predicted_gains=(PREDICTED,))
    ),
    "improvement of nothing": lambda: plot_improvement(improvement(1)),
    "improvement by a learned force": lambda: plot_improvement(learned()),
    "learned force": lambda: plot_learned_force(learned()),
    "learned force that was held": lambda: plot_learned_force(learned(std=np.full(12, np.nan))),
    "learned torque against the angle": lambda: plot_learned_force(
        learned(port="arm", variable="arm_angle", at=np.linspace(-np.pi, np.pi, 12))
    ),
    "recording": lambda: plot_recording(recording()),
    "where": lambda: plot_where(diagnosis()),
    "where of thirty": lambda: plot_where(diagnosis(where=places(0.9, experiments=30))),
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
    assert "cart position is predicted one sample ahead better, from 1.60 to 1.10 times the noise" in stated


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
        re.findall(r"between ([\d.]+) and ([\d.]+)\sHz", drawn["bands of one"].get_suptitle().replace("\n", " "))[0],
    )
    assert low < 37.4 / (2 * np.pi) < high
    coloured = drawn["bands of coloured noise"]
    assert "times white noise, and its noise is taken for coloured" in coloured.get_suptitle().replace("\n", " ")
    assert coloured.get_axes()[0].get_title(loc="left") == "cart position, noise taken for coloured"
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
        found.append(band_errors(Compared("model", RTAC.paper(), (one,), {}, {}), "cart_position", edges))
    np.testing.assert_allclose(found[0], 1.0, atol=0.1)
    # All of the sine's power, 1 in units of the noise over 100 Hz, lies in 2 Hz, beside 1/50 of the noise.
    np.testing.assert_allclose(found[1], [1.0, np.sqrt(51.0), 1.0], rtol=0.1)


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


def test_where_the_model_fails_is_named_and_every_part_stands_in_its_order(drawn):
    assert "fails most in arm velocity at 0 to 23.3 rad/s" in drawn["where"].get_suptitle().replace("\n", " ")
    panel = next(a for a in drawn["where"].get_axes() if a.get_xlabel() == "Frequency [rad/s]")
    assert [t.get_text().split("\n")[0] for t in panel.get_xticklabels()] == ["0", "23.3", "69.8", "209"]
    bold = [t.get_text() for a in drawn["where"].get_axes() for t in a.texts if t.get_fontweight() == "bold"]
    assert bold == ["9.00"]
    assert "as large as the noise in every part" in drawn["where of thirty"].get_suptitle()
    top = drawn["where of thirty"].get_axes()[0]
    assert len(top.get_xticks()) == 12
    assert "worst 12 of 30" in top.get_xlabel()
    motion = plot_where(diagnosis(where=places(at=("cart_position", "arm_velocity", 2))))
    assert "where the cart position is 4 mm to 6 mm in size" in motion.get_suptitle().replace("\n", " ")
    panel = next(a for a in motion.get_axes() if a.get_xlabel() == "Size of the cart position [mm]")
    assert [t.get_text() for t in panel.get_xticklabels()] == ["0\nto 2", "2\nto 4", "4\nto 6", "6\nto 8"]
    assert "No part of the data" in plot_where(diagnosis("adequate")).get_suptitle()
    with pytest.raises(ValueError, match="holds no innovations"):
        plot_where(diagnosis(where=()))


def test_what_looks_alike_is_named(drawn):
    assert "effect_1 looks much like flexible_mode" in drawn["confusion"].get_suptitle().replace("\n", " ")
    assert len(drawn["confusion"].get_axes()[0].get_xticks()) == 12
    assert "told apart" not in drawn["confusion"].get_suptitle()
    fitted = [dataclasses.replace(c, refitted=True, bic_gain=20.0) for c in alike(3, 0.95)]
    told = plot_confusion(diagnosis(others=fitted)).get_suptitle().replace("\n", " ")
    ahead = diagnosis().effects[0].bic_gain - 20.0
    assert told.endswith(f", but fitted they are told apart, by {ahead:.0f} in BIC")
    untestable = dataclasses.replace(candidate("no_way", 60.0), testable=False)
    assert [c.id for c in confusable(diagnosis(others=(untestable, *alike(3, 0.2))))] == [
        "flexible_mode", "effect_0", "effect_1", "effect_2",
    ]  # fmt: skip


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


def test_where_a_variable_never_was_no_force_is_drawn():
    std = np.where(np.arange(12) < 3, np.inf, CURVES[0].std)
    figure = plot_diagnosis(diagnosis(curves=(dataclasses.replace(CURVES[0], std=std), *CURVES[1:])))
    panel = next(a for a in figure.get_axes() if a.get_title(loc="left").startswith("against cart position"))
    line = next(line for line in panel.lines if line.get_label() == "missing")
    assert np.array_equal(np.isnan(line.get_ydata()), np.arange(12) < 3)
    assert np.all(np.isfinite(panel.get_ylim()))


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


def test_what_simulations_select_is_drawn_as_accepted_by_them():
    refitted = candidate("encoder_lag", 900.0, refitted=True, bic_gain=800.0, error_reduction=0.99)
    selected = dataclasses.replace(diagnosis(others=(refitted, *OTHERS)), by_simulation=True, removed=0.97)
    assert finding(selected) == "flexible_mode explains 97 % of the simulation's squared error beyond the noise"
    texts = [t.get_text() for axes in plot_diagnosis(selected).axes for t in axes.texts]
    assert "accepted by simulation" in texts
    assert "predictions alone gain 99 %" in texts


@pytest.mark.parametrize("width", [6.0, 8.0, 9.6, 12.0])
def test_no_title_is_broken_before_a_percent_sign(width):
    for length in range(1, 60):
        figure = Figure(figsize=(width, 3))
        title(figure, f"{'m' * length} together explain 100 % of the simulation's squared error beyond the noise")
        assert not any(line.startswith("%") for line in figure.get_suptitle().splitlines())
        assert "100 %" in figure.get_suptitle()


@pytest.mark.parametrize(("left", "shown"), [(40.0, "forced_1"), (1.0, "free_1")])
def test_the_experiment_is_drawn_that_the_last_model_follows_worst_where_it_is_far_from_it(
    left: float, shown: str
) -> None:
    """Where it follows all of them, the one that the base model was farthest from."""
    before, after = compared("base", 60.0), compared("+ mode", left, names=("forced_1", "free_1"))
    found = dataclasses.replace(improvement(2), validation=Comparison((before, after)))
    titles = [axes.get_title(loc="left") for axes in plot_improvement(found).axes]
    assert any(title.startswith(f"held out: {shown}:") for title in titles), titles


def test_curves_are_scaled_to_what_the_data_tell_from_nothing():
    """A band as wide as that of a slope that the model estimates itself would make a flat line of all others."""
    told, vague = curve("cart", "cart_position", 0.01), curve("cart", "cart_velocity", 0.1)
    vague = dataclasses.replace(vague, std=np.full(12, 0.7))
    assert _reach([told, vague]) == pytest.approx(0.05 + 2 * 0.004)
    assert _reach([vague]) == pytest.approx(0.05 + 2 * 0.7)
    assert _reach([]) == 1.0
