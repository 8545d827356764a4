"""Measured and simulated signals in a page, to be zoomed in any browser, without a network."""

import importlib.resources
import json
from typing import Any

import numpy as np

from estimators.plots.style import NAMES, UNITS, largest, prefixed, worst_stretch
from estimators.reporting.html import Embedded
from estimators.validation.simulation_error import Comparison, Trace

_MOST = 150_000  # numbers in a page, which are about a megabyte
_LONGEST = 30_000  # samples of one signal; of a longer one the part with the largest error is shown


def trace_viewer(comparison: Comparison, *, most: int = _MOST) -> Embedded:
    """Return a picture of every channel of the worst experiments that a reader can zoom.

    Args:
        comparison: of one or several models.
        most: numbers that may go into the page; where there are more, the experiments with the largest errors are kept.
    """
    every = {(t.experiment, t.channel): [] for t in comparison.models[0].worst(len(comparison.models[0].traces))}
    for model in comparison.models:
        for trace in model.traces:
            if (trace.experiment, trace.channel) in every:
                every[trace.experiment, trace.channel].append((model.label, trace))
    shown, used = [], 0
    for several in every.values():
        size = (len(several) + 1) * min(len(several[0][1].time), _LONGEST)
        if shown and used + size > most:
            break
        shown.append(_signals(several))
        used += size
    # No text may end the element that holds it.
    data = json.dumps(shown, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    script = importlib.resources.files("estimators.reporting").joinpath("trace_viewer.js").read_text(encoding="utf-8")
    some = "" if len(shown) == len(every) else f" The {len(shown)} of {len(every)} with the largest errors."
    caption = (
        "To be zoomed: the buttons, or the wheel after a click; dragging moves, a double click shows all. "
        f"Residuals are measured less simulated.{some}"
    )
    return Embedded(
        f'<figure class="viewer"><script type="application/json">{data}</script></figure>\n'
        f'<p class="caption">{caption}</p>',
        script,
    )


def _signals(several: list[tuple[str, Trace]]) -> dict[str, Any]:
    """Return one channel of one experiment as JSON knows it: measured, then every model."""
    first = several[0][1]
    part = worst_stretch(first.residual, _LONGEST, longest=_LONGEST)
    scale = prefixed(largest(first.measured), UNITS[first.channel])
    series = [{"label": "measured", "values": _numbers(scale.factor * first.measured[part])}]
    series += [{"label": label, "values": _numbers(scale.factor * t.simulated[part])} for label, t in several]
    return {
        "name": f"{first.experiment}: {NAMES[first.channel]} ({first.rms / first.noise:.3g} times the noise)",
        "unit": scale.unit,
        "start": float(first.time[part.start]),
        "step": float(first.time[1] - first.time[0]) if len(first.time) > 1 else 1.0,
        "series": series,
    }


def _numbers(values: np.ndarray) -> list[float | None]:
    """Return numbers in five figures, which is finer than a screen; None where nothing was measured."""
    return [float(f"{v:.5g}") if np.isfinite(v) else None for v in values]
