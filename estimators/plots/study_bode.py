"""Bands of Bode curves of a Monte Carlo study: the responses of all estimates beside the true ones."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Complex128, Float

from estimators.plots.envelope import frequency_axis
from estimators.plots.style import MARKERS, MODELS, SMALL, Picture, picture, tidy, title
from estimators.study.results import StudyResults
from estimators.study.truth import small_motion, true_for

_LEVEL = 95.0  # percent of the repetitions that a band holds at each frequency
_POINTS = 240
_AROUND = 2.0  # times the resonance, below and above it, that is drawn


def plot_bode_bands(found: StudyResults) -> Picture:
    """Draw the response of small motions about theta = 0, equation (4), of all estimates over that of their truths.

    What an estimator does not estimate has its true value.

    Raises:
        ValueError: no estimate changes that response.
    """
    truths = [_true_values(found, int(index)) for index in found.index]
    usual = {name: float(np.median([one[name] for one in truths])) for name in truths[0]}
    resonance = usual["natural frequency"]
    omega = np.geomspace(resonance / _AROUND, _AROUND * resonance, _POINTS)
    true = np.stack([_response(one, omega) for one in truths])
    bands = {name: ratio for e, name in enumerate(found.estimators) if (ratio := _ratios(found, e, truths, true, omega))
             is not None}  # fmt: skip
    if not bands:
        raise ValueError("no estimate changes the response of small motions, so there is no band to draw.")
    figure = picture(7.6, 6.4)
    top, middle, below = figure.subplots(3, 1, sharex=True, height_ratios=[1.2, 1, 1])
    top.semilogx(omega, 20 * np.log10(np.abs(_response(usual, omega))), **MODELS[0])
    top.set_ylabel("True magnitude\n[dB above 1 m/(N m)]", fontsize=SMALL)
    widest, of = 0.0, ""
    for n, (name, ratio) in enumerate(bands.items()):
        style = MODELS[(n + 1) % len(MODELS)]
        for axes, values in ((middle, 20 * np.log10(np.abs(ratio))), (below, np.degrees(np.angle(ratio)))):
            low, centre, high = np.percentile(values, [50 - _LEVEL / 2, 50, 50 + _LEVEL / 2], axis=0)
            axes.fill_between(omega, low, high, color=style["color"], alpha=0.25, linewidth=0)
            axes.semilogx(
                omega, centre, color=style["color"], linewidth=1.5, marker=MARKERS[n % len(MARKERS)],
                markevery=(7 * n, 40), markersize=4, label=name,
            )  # fmt: skip
        spread = float(np.max(np.percentile(np.abs(ratio - 1), _LEVEL, axis=0)))
        if spread > widest:
            widest, of = spread, name
    for axes, words in ((middle, "Estimated over\ntrue magnitude [dB]"), (below, "Estimated less\ntrue phase [deg]")):
        axes.axhline(0.0, color="black", linewidth=0.8, linestyle="--")
        axes.set_ylabel(words, fontsize=SMALL)
    below.set_xlabel("Frequency [rad/s]", fontsize=SMALL)
    for axes in (top, middle, below):
        tidy(axes)
        axes.margins(x=0.0)
        frequency_axis(axes)
    middle.legend(fontsize=SMALL, loc="best", ncols=2, framealpha=0.9)
    title(
        figure,
        f"{_LEVEL:.0f} % of the estimated responses lie within {100 * widest:.2g} % of the true ones ({of}, where it is widest)",
    )
    return figure


def _true_values(found: StudyResults, index: int) -> dict[str, float]:
    """Return the truth of one repetition, those parameters included that were not estimated."""
    return true_for(found.spec, index).values


def _ratios(
    found: StudyResults,
    e: int,
    truths: Sequence[Mapping[str, float]],
    true: Complex128[np.ndarray, "repetition frequency"],
    omega: Float[np.ndarray, " frequency"],
) -> Complex128[np.ndarray, "kept frequency"] | None:
    """Return estimated over true response of the repetitions that did not fail; None where no estimate changes it."""
    names = found.layout.coordinates["parameter"]
    ratios = []
    for row, (values, response) in enumerate(zip(truths, true, strict=True)):
        own = dict(zip(names, found.arrays["estimate"][row, e], strict=True))
        estimated = {name: float(value) for name, value in own.items() if np.isfinite(value) and name in values}
        changed = _response({**values, **estimated}, omega) / response
        if np.any(changed != 1.0):
            ratios.append(changed)
    return np.stack(ratios) if ratios else None


def _response(
    values: Mapping[str, float], omega: Float[np.ndarray, " frequency"]
) -> Complex128[np.ndarray, " frequency"]:
    """Return the cart's position per torque on the arm [m/(N m)]."""
    inertias, forces = small_motion(values)
    torque = np.array([0.0, 0.0, 1.0])
    matrices = 1j * omega[:, None, None] * inertias - forces
    return np.linalg.solve(matrices, np.broadcast_to(torque[:, None], (len(omega), 3, 1)))[:, 0, 0]
