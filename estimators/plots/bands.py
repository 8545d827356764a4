"""The error of simulation by frequency, before and after."""

from collections.abc import Collection

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from scipy.signal import periodogram

from estimators.plots.style import HATCHES, NAMES, SMALL, Picture, picture, plain_log_axis, tidy, times, title
from estimators.validation.simulation_error import Compared, Comparison, Trace
from rtac_jax.measurement import filled

_BANDS = 8
_TONES = ("#e6550d", "#08306b", "0.75")
_LONGEST = 2.0  # periods of the lowest frequency that the shortest experiment holds

Edges = Float[np.ndarray, " edge"]


def plot_bands(comparison: Comparison, *, coloured: Collection[str] = ()) -> Picture:
    """Draw the error of each channel in bands of frequency, in units of what white noise of the sensor has there.

    The first and the last model are shown, over all experiments.

    Args:
        comparison: of one or more models with the measurements.
        coloured: channels of which a diagnosis took the noise for coloured: what lies above white noise need be no error.
    """
    models = list(comparison.models)
    shown = models if len(models) == 1 else [models[0], models[-1]]
    channels = list(dict.fromkeys(t.channel for t in shown[0].traces))
    edges = _edges(shown[0].traces)
    ratios = {(m.label, c): band_errors(m, c, edges) for m in shown for c in channels}
    figure = picture(9.6, 3.4)
    for axes, channel in zip(np.atleast_1d(figure.subplots(1, len(channels), sharey=True)), channels, strict=True):
        _draw(axes, {m.label: ratios[m.label, channel] for m in shown}, edges)
        noise = ", noise taken for coloured" if channel in coloured else ""
        axes.set_title(f"{NAMES[channel]}{noise}", fontsize=9, loc="left")
    figure.axes[0].set_ylabel("rms of residual / white noise in the band [1]", fontsize=SMALL)
    figure.axes[0].legend(fontsize=SMALL, loc="upper right")
    title(figure, _finding({c: [ratios[m.label, c] for m in shown] for c in channels}, edges, coloured))
    return figure


def band_errors(compared: Compared, channel: str, edges: Edges) -> Float[np.ndarray, " band"]:
    """Return the rms of the residual in each band over that of white noise with the sensor's standard deviation.

    Args:
        compared: a model against the measurements.
        channel: whose residuals.
        edges: of the bands [Hz].
    """
    power, noise = np.zeros(len(edges) - 1), np.zeros(len(edges) - 1)
    for trace in (t for t in compared.traces if t.channel == channel):
        step = float(trace.time[1] - trace.time[0])
        residual = filled(trace.residual[np.argmax(np.isfinite(trace.residual)) :])
        frequency, density = periodogram(residual, 1 / step)
        band = np.digitize(frequency, edges) - 1
        inside = (band >= 0) & (band < len(power)) & (frequency > 0)
        # Both count the same lines, so that their edges do not matter.
        power += np.bincount(band[inside], density[inside], len(power))
        noise += np.bincount(band[inside], np.full(int(inside.sum()), 2 * step * trace.noise**2), len(power))
    return np.sqrt(power / np.where(noise > 0, noise, np.inf))


def _edges(traces: tuple[Trace, ...]) -> Edges:
    """Return edges of bands of equal width on a log scale, up to half the slowest sampling rate [Hz]."""
    longest = min(float(t.time[-1] - t.time[0]) for t in traces)
    rate = min(1 / float(t.time[1] - t.time[0]) for t in traces)
    return np.geomspace(min(_LONGEST / longest, rate / 8), 0.5 * rate * (1 + 1e-9), _BANDS + 1)


def _draw(axes: Axes, ratios: dict[str, np.ndarray], edges: Edges) -> None:
    width = 0.8 / len(ratios)
    for number, (name, values) in enumerate(ratios.items()):
        axes.bar(
            np.arange(len(values)) + (number - 0.5 * (len(ratios) - 1)) * width, values, width=width, label=name,
            color=_TONES[number], hatch=HATCHES[1 - number] if len(ratios) > 1 else "", edgecolor="black", linewidth=0.5,
        )  # fmt: skip
    axes.axhline(1.0, color="black", linestyle="--", linewidth=1)
    axes.set_yscale("log")
    plain_log_axis(axes.yaxis, *axes.get_ylim())
    axes.set_xticks(np.arange(len(edges)) - 0.5, [_short(edge) for edge in edges])
    axes.set_xlabel("Frequency [Hz]   (dashed: white noise of the sensor)", fontsize=SMALL)
    tidy(axes)
    axes.grid(False, axis="x")


def _finding(ratios: dict[str, list[np.ndarray]], edges: Edges, coloured: Collection[str]) -> str:
    channel = max(ratios, key=lambda c: float(np.max(ratios[c][0])))
    first, *later = ratios[channel]
    worst = int(np.argmax(first))
    between = f"between {_short(edges[worst])} and {_short(edges[worst + 1])}\N{NO-BREAK SPACE}Hz"
    where = f"{NAMES[channel]} {between}"
    noise = "white noise, and its noise is taken for coloured" if channel in coloured else "the noise"
    if not later:
        if first[worst] < 1.5:
            return (
                f"The error lies at the noise floor in every band of frequency, {times(first[worst])} times it at most"
            )
        return f"The error is largest in {where}: {times(first[worst])} times {noise}"
    verb = "falls" if later[-1][worst] < first[worst] else "rises"
    change = f"{verb} from {times(first[worst])} to {times(later[-1][worst])} times {noise}"
    return f"The error is largest in {where}, where it {change}"


def _short(edge: float) -> str:
    return f"{float(f'{edge:.2g}'):g}"
