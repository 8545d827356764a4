"""Frequency responses of all conditions, the nominal model among them, and the weight above their model errors."""

from typing import Any

import numpy as np
from jaxtyping import Complex128, Float64
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, MultipleLocator, NullFormatter

from estimators.frequency_response.response import FrequencyResponse, FrequencyResponses
from estimators.plots.style import HATCHES, SMALL, UNITS, Picture, picture, tidy, title
from estimators.uncertainty.attribution import SOURCES
from estimators.uncertainty.closed_form_check import ClosedFormCheck
from estimators.uncertainty.effect_cost import EffectCost
from estimators.uncertainty.envelope import Envelope
from estimators.uncertainty.fitted_model import FittedInEnvelope
from estimators.uncertainty.nominal_model import log_measure
from estimators.uncertainty.uncertainty_structures import errors

Response = Complex128[np.ndarray, " frequency"]
_PLANT: dict[str, Any] = {"color": "0.6", "linewidth": 0.7}
_HELD: dict[str, Any] = {"color": "0.35", "linewidth": 0.7, "linestyle": (0, (1, 1.5))}
_NOMINAL: dict[str, Any] = {"color": "#08306b", "linewidth": 2.0}
_WEIGHT: dict[str, Any] = {"color": "#e6550d", "linewidth": 2.0, "linestyle": "--"}
_CLOSED: dict[str, Any] = {"color": "black", "linewidth": 1.3, "linestyle": "-."}
_FITTED: dict[str, Any] = {"color": "#31a354", "linewidth": 1.4, "linestyle": "-."}
_TONES = ("#08306b", "#e6550d", "0.75", "white")
_WORDS = {
    "unmodelled": "unmodelled by P₀",
    "amplitude": "amplitude",
    "scatter": "scatter of conditions",
    "estimation": "estimation (noise)",
}
_MOST_LINES = 60


def plot_responses(responses: FrequencyResponses) -> Picture:
    """Draw magnitude and phase of every condition; the band is the 95 % disc of the least certain one."""
    figure = picture(8.0, 5.4)
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    for one in responses:
        top.semilogx(one.frequency, decibel(np.abs(one.response)), **_PLANT)
        below.semilogx(one.frequency, degrees(one.response), **_PLANT)
    fractions = np.concatenate([one.radius(0.95) / np.abs(one.response) for one in responses])
    noisy = max(responses, key=lambda one: float(np.median(one.std / np.abs(one.response))))
    size, radius = np.abs(noisy.response), noisy.radius(0.95)
    top.fill_between(
        noisy.frequency, decibel(np.maximum(size - radius, 0.1 * size)), decibel(size + radius), color="#fdd0a2",
        linewidth=0, label=f"95 % of {noisy.name}, the least certain",
    )  # fmt: skip
    for row, level in enumerate(("odd_distortion", "even_distortion")):
        known = [(one.frequency, getattr(one, level)) for one in responses if getattr(one, level) is not None]
        if known:
            omega, values = known[0]
            style = ("-.", ":")[row]
            top.semilogx(
                omega, decibel(np.maximum(values, 1e-3 * size.max())), color="black", linewidth=1.1, linestyle=style,
                label=f"{level.split('_')[0]} distortion of {responses[0].name}",
            )  # fmt: skip
    top.set_ylabel(gain_label(responses[0]), fontsize=SMALL)
    below.set_ylabel("Phase [deg]", fontsize=SMALL)
    below.set_yticks(np.arange(-360, 361, 90))
    below.set_ylim(-200, 200)
    below.set_xlabel("Frequency [rad/s]", fontsize=SMALL)
    top.legend(fontsize=SMALL, loc="best")
    for axes in (top, below):
        frequency_axis(axes)
    median = 100 * float(np.median(fractions))
    fed_back = sum(one.feedback > 0 for one in responses)
    known = f"each known to {median:.2g} % (95 % radius, median)"
    if fed_back:
        known = f"of which {fed_back} answer the noise of the output, which no radius counts"
    title(figure, f"{len(responses)} conditions, {known}")
    return figure


def plot_envelope(
    envelope: Envelope, closed_form: ClosedFormCheck | None = None, fitted: FittedInEnvelope | None = None
) -> Picture:
    """Draw Fig. 6: responses with the nominal model, the model errors with the weight, and the sources of the errors.

    Args:
        envelope: of several conditions.
        closed_form: drawn beside the responses, in all panels but the last.
        fitted: the fitted physical model beside it, whose curve is drawn too.
    """
    figure = picture(8.0, 8.6)
    axes = figure.subplots(4, 1, sharex=True, height_ratios=[2.0, 1.0, 1.7, 1.0])
    draw_responses(axes[0], envelope)
    nominal = envelope.nominal_response()
    phase = np.degrees(np.unwrap(np.angle(nominal)))
    for plant, held in _shown(envelope, envelope.plants):
        # About the nominal phase, so that a crossing of 180 degrees is no jump.
        axes[1].semilogx(envelope.frequency, phase + degrees(plant / nominal), **(_HELD if held else _PLANT))
    axes[1].semilogx(envelope.frequency, phase, **_NOMINAL)
    if fitted is not None:
        beside = fitted.response / envelope.nominal_response(fitted.frequency)
        along = np.interp(fitted.frequency, envelope.frequency, phase)
        axes[0].semilogx(
            fitted.frequency, decibel(np.abs(fitted.response)), **_FITTED, label="fitted model, linearised"
        )
        axes[1].semilogx(fitted.frequency, along + degrees(beside), **_FITTED)
        axes[0].legend(fontsize=SMALL, loc="lower left", framealpha=0.9)
    axes[1].yaxis.set_major_locator(MultipleLocator(90))
    axes[1].set_ylabel("Phase [deg]", fontsize=SMALL)
    draw_profile(axes[2], envelope)
    if closed_form is not None:
        omega, word = closed_form.frequency, "closed form, linearised"
        axes[0].semilogx(omega, decibel(np.abs(closed_form.response)), **_CLOSED, label=word)
        axes[1].semilogx(omega, phase + degrees(closed_form.response / nominal), **_CLOSED)
        model_error = np.abs(errors(closed_form.response[None], nominal, envelope.kind))[0]
        axes[2].semilogx(omega, decibel(np.maximum(model_error, 1e-3 * envelope.profile.max())), **_CLOSED, label=word)
        axes[0].legend(fontsize=SMALL, loc="lower left", framealpha=0.9)
    if fitted is not None and envelope.kind.startswith("multiplicative"):
        model_error = np.abs(fitted.response / envelope.nominal_response(fitted.frequency) - 1)
        axes[2].semilogx(fitted.frequency, decibel(np.maximum(model_error, 1e-3)), **_FITTED, label="fitted model")
        axes[2].set_ylim(top=max(axes[2].get_ylim()[1], float(decibel(model_error).max()) + 3))
    if closed_form is not None or fitted is not None:
        axes[2].legend(fontsize=SMALL, loc="lower left", ncols=3, framealpha=0.9)
    _draw_sources(axes[3], envelope)
    axes[3].set_xlabel("Frequency [rad/s]", fontsize=SMALL)
    for panel in (axes[1], axes[3]):
        frequency_axis(panel)
    title(figure, finding(envelope))
    return figure


def plot_effect_cost(cost: EffectCost) -> Picture:
    """Draw the largest model errors of the same conditions about both models, under the weights that cover them."""
    figure = picture(8.0, 4.2)
    axes = figure.subplots()
    for word, found, colour in (("before", cost.before, _WEIGHT["color"]), ("after", cost.after, _NOMINAL["color"])):
        gamma = cost.price.gamma[word]
        axes.semilogx(
            found.frequency,
            decibel(found.profile),
            color=colour,
            linewidth=2.0,
            label=f"{word}: largest model error, γ = {gamma:.3f}",
        )
        dense = np.geomspace(found.frequency[0], found.frequency[-1], 800)
        axes.semilogx(
            dense,
            decibel(found.weight_magnitude(dense)),
            color=colour,
            linewidth=1.2,
            linestyle="--",
            label=f"{word}: |W|",
        )
    axes.axhline(0.0, color="black", linestyle=":", linewidth=1.0)
    axes.set_ylabel("|ΔW| needed [dB]", fontsize=SMALL)
    axes.set_xlabel("Frequency [rad/s]", fontsize=SMALL)
    axes.legend(fontsize=SMALL, ncols=2, framealpha=0.9)
    frequency_axis(axes)
    before, after = (100 * float(found.profile.max()) for found in (cost.before, cost.after))
    named = ", ".join(cost.effects) or "nothing more"
    title(figure, f"Knowing {named} brings the largest model error from {before:.0f}\u00a0% to {after:.0f}\u00a0%")
    return figure


def finding(envelope: Envelope) -> str:
    """Say in one line what the envelope covers and where it is useful."""
    at = int(np.argmax(envelope.profile))
    orders = (len(envelope.nominal.poles()), len(envelope.weight.poles()))
    text = f"One model of order {orders[0]} and a weight of order {orders[1]} cover {len(envelope.plants)} conditions"
    if envelope.kind == "additive":
        return text
    useful = float(log_measure(envelope.frequency) @ (envelope.weight_magnitude() < 1))
    where = f"largest model error {100 * envelope.profile[at]:.0f}\u00a0% at {envelope.frequency[at]:.3g}\u00a0rad/s"
    return f"{text}; {where}, |W| < 1 on {100 * useful:.0f}\u00a0% of the band"


def gain_label(response: FrequencyResponse) -> str:
    """Return the label of an axis that shows the magnitude of a response."""
    ratio = f"{UNITS[response.output]} / {UNITS[response.input]}"
    name = response.input.replace("_", " ") + (" × cos θ" if response.compensated else "")
    return f"|{response.output.replace('_', ' ')} / ({name})|\n[dB above 1 {ratio}]"


def draw_responses(axes: Axes, envelope: Envelope) -> None:
    """Draw magnitudes of the conditions and of the nominal model, as in Figs. 5 and 6(a)."""
    named: set[bool] = set()
    for plant, held in _shown(envelope, envelope.plants):
        text = None if held in named else ("held out" if held else f"{len(envelope.plants)} conditions")
        axes.semilogx(envelope.frequency, decibel(np.abs(plant)), **(_HELD if held else _PLANT), label=text)
        named.add(held)
    axes.semilogx(envelope.frequency, decibel(np.abs(envelope.nominal_response())), **_NOMINAL, label="nominal P₀")
    axes.set_ylabel("Magnitude\n[dB above 1 output/input]", fontsize=SMALL)
    axes.legend(fontsize=SMALL, loc="lower left", framealpha=0.9)
    frequency_axis(axes)


def draw_profile(axes: Axes, envelope: Envelope) -> None:
    """Draw the model errors of the conditions, their largest and the weight, as in Fig. 6(b)."""
    for model_error, held in _shown(envelope, envelope.model_errors):
        axes.semilogx(
            envelope.frequency,
            decibel(np.maximum(model_error, 1e-3 * envelope.profile.max())),
            **(_HELD if held else _PLANT),
        )
    axes.semilogx(envelope.frequency, decibel(envelope.profile), **_NOMINAL, label="profile: the largest model error")
    dense = np.geomspace(envelope.frequency[0], envelope.frequency[-1], 800)
    axes.semilogx(dense, decibel(envelope.weight_magnitude(dense)), **_WEIGHT, label="weight |W|")
    if envelope.kind != "additive":
        axes.axhline(0.0, color="black", linestyle=":", linewidth=1.0)
    low = decibel(np.array([envelope.profile.min()]))[0] - 12
    axes.set_ylim(max(low, -60) if envelope.kind != "additive" else low)
    axes.set_ylabel("|ΔW| needed [dB]", fontsize=SMALL)
    axes.legend(fontsize=SMALL, loc="lower left", ncols=2, framealpha=0.9)
    frequency_axis(axes)


def _draw_sources(axes: Axes, envelope: Envelope) -> None:
    fractions = 100 * envelope.attribution.fractions
    base = np.zeros(len(envelope.frequency))
    for number, name in enumerate(SOURCES):
        axes.fill_between(
            envelope.frequency, base, base + fractions[number], color=_TONES[number], hatch=(*HATCHES, "\\\\")[number],
            edgecolor="0.3", linewidth=0.4, label=_WORDS[name],
        )  # fmt: skip
        base = base + fractions[number]
    axes.set_xscale("log")
    axes.set_ylim(0, 100)
    axes.set_ylabel("Fraction of the\nsquared model error [%]", fontsize=SMALL)
    axes.legend(fontsize=SMALL, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)


def _shown(envelope: Envelope, rows: np.ndarray) -> list[tuple[np.ndarray, bool]]:
    """Return some of many rows, spread over all."""
    step = max(1, len(rows) // _MOST_LINES)
    return [(rows[i], bool(envelope.held_out[i])) for i in range(0, len(rows), step)]


def frequency_axis(axes: Axes) -> None:
    """Tidy axes over a logarithmic frequency, with plain numbers at 1, 2 and 5 of every decade."""
    tidy(axes)
    axes.grid(True, which="minor", axis="x", color="0.95", linewidth=0.4)
    axes.margins(x=0.0)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def decibel(values: Float64[np.ndarray, " frequency"]) -> Float64[np.ndarray, " frequency"]:
    """Return magnitudes in decibel, those of nothing far below any other."""
    return 20 * np.log10(np.maximum(values, 1e-300))


def degrees(values: Response) -> Float64[np.ndarray, " frequency"]:
    """Return the phase in degrees; a jump by a whole turn is not drawn."""
    phase = np.degrees(np.angle(values))
    return np.where(np.abs(np.diff(phase, prepend=phase[0])) > 180, np.nan, phase)
