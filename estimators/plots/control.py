"""Pictures of control: open against closed loop, the loop's functions against their weights, margins, many plants."""

from typing import Any

import numpy as np

from estimators.plots.style import MODELS, SMALL, Picture, picture, plain_log_axis, prefixed, tidy, title
from rtac_jax.control import ClosedLoop, Margins, Synthesis

_OPEN: dict[str, Any] = {"color": "0.55", "linewidth": 1.6, "linestyle": ":"}
_CLOSED = (MODELS[1], MODELS[0], MODELS[2])
_BAND: dict[str, Any] = {"color": "0.91", "linewidth": 0}
_BOUND: dict[str, Any] = {"color": "black", "linewidth": 1.0, "linestyle": "--"}


def plot_closed_loop(free: ClosedLoop, closed: dict[str, ClosedLoop], *, plant: int = 0) -> Picture:
    """Draw open against closed loop: cart position, arm angle and torque of one plant (Fig. 8 of the paper).

    Args:
        free: without a controller.
        closed: responses by the name to show.
        plant: number of the column.
    """
    figure = picture(9.0, 6.4)
    axes = figure.subplots(3, 1, sharex=True)
    every = {"open loop": free, **closed}
    styles = [_OPEN, *_CLOSED]
    largest = max(float(np.max(np.abs(r.cart_position[:, plant]))) for r in every.values())
    place = prefixed(largest, "m")
    force = prefixed(max(float(r.peak_torque[plant]) for r in closed.values()), "N m")
    for (name, response), style in zip(every.items(), styles, strict=False):
        axes[0].plot(response.time, place.factor * response.cart_position[:, plant], label=name, **style)
        axes[1].plot(response.time, response.arm_angle[:, plant], **style)
        axes[2].step(response.time, force.factor * response.torque[:, plant], where="post", **style)
    first = 0.1 * abs(float(free.cart_position[0, plant]))
    axes[0].axhspan(-place.factor * first, place.factor * first, zorder=0, **_BAND)
    axes[1].axhspan(-0.5 * np.pi, 0.5 * np.pi, zorder=0, **_BAND)
    reach = max(min(float(np.max(np.abs(r.arm_angle[:, plant]))), 3 * np.pi) for r in every.values())
    axes[1].set_ylim(-1.05 * max(reach, 2.0), 1.05 * max(reach, 2.0))
    for axis, text in zip(
        axes, (f"Cart position [{place.unit}]", "Arm angle [rad]", f"Motor torque [{force.unit}]"), strict=True
    ):
        axis.set_ylabel(text, fontsize=SMALL)
        tidy(axis)
    axes[0].set_title("grey: a tenth of the displacement at the start", fontsize=SMALL, loc="left")
    axes[1].set_title("grey: the half circle in which the arm's push keeps its direction", fontsize=SMALL, loc="left")
    axes[0].legend(fontsize=SMALL, loc="upper right")
    axes[2].set_xlabel("Time [s]", fontsize=SMALL)
    told = [f"{name} {_seconds(float(r.settling_time()[plant]))}" for name, r in every.items()]
    title(figure, "The cart stays under a tenth after: " + ", ".join(told))
    return figure


def plot_synthesis(synthesis: Synthesis) -> Picture:
    """Draw S, T and C S under what their weights allow for this gamma."""
    figure = picture(9.6, 3.8)
    w, weights = synthesis.frequency, synthesis.weights
    rows = (
        ("S", synthesis.sensitivity, weights.performance, "γ / |W₃ W_d|"),
        ("T", synthesis.complementary, weights.uncertainty, "1 / |W|"),
        ("C S", synthesis.effort, weights.effort, "γ / |W₁ W_d|"),
    )
    for axis, (name, curve, weight, bound) in zip(figure.subplots(1, 3), rows, strict=True):
        allowed = (1.0 if name == "T" else synthesis.gamma) / np.abs(weight(1j * w))
        axis.loglog(w, np.abs(curve), color=MODELS[1]["color"], linewidth=1.4, label=f"|{name}|")
        axis.loglog(w, allowed, label=bound, **_BOUND)
        shown = _band(synthesis)
        axis.set_xlim(*shown)
        inside = (w >= shown[0]) & (w <= shown[1])
        values = np.concatenate([np.abs(curve)[inside], allowed[inside]])
        axis.set_ylim(max(0.5 * values.min(), 1e-4 * values.max()), 2 * values.max())
        axis.set_xlabel("Frequency [rad/s]", fontsize=SMALL)
        axis.legend(fontsize=SMALL)
        plain_log_axis(axis.yaxis, values.min(), values.max())
        tidy(axis)
    figure.axes[0].set_ylabel("Magnitude [1]", fontsize=SMALL)
    stays = "stays under" if synthesis.robustness < 1 else "passes"
    title(
        figure,
        f"γ = {synthesis.gamma:.2f}; T {stays} what the envelope allows, max |W T| = {synthesis.robustness:.2f}",
    )
    return figure


def plot_margins(found: Margins) -> Picture:
    """Draw robust stability and robust performance over frequency."""
    figure = picture(7.4, 3.8)
    axis = figure.subplots()
    (stability, _), (performance, at) = found.worst_stability, found.worst_performance
    axis.semilogx(found.frequency, found.stability, color=MODELS[1]["color"], label="robust stability: |W T|")
    axis.semilogx(
        found.frequency, found.performance, color=MODELS[0]["color"], linestyle="--",
        label="robust performance: |W T| + |W₃ W_d S|",
    )  # fmt: skip
    axis.axhline(1.0, **_BOUND)
    axis.plot(at, performance, "o", color=MODELS[0]["color"], markersize=4)
    axis.set_xlim(at / 100, 100 * at)
    axis.set_ylim(0, 1.15 * max(1.0, performance))
    axis.set_xlabel("Frequency [rad/s]", fontsize=SMALL)
    axis.set_ylabel("Fraction of what is allowed [1]", fontsize=SMALL)
    axis.legend(fontsize=SMALL)
    tidy(axis)
    stable = "stable for the whole envelope" if stability < 1 else "stability is not guaranteed for the whole envelope"
    title(figure, f"{stable[0].upper()}{stable[1:]}; performance reaches {performance:.2f} at {at:.3g} rad/s")
    return figure


def plot_batch(batch: ClosedLoop, *, free: ClosedLoop | None = None, within: float = 3.0) -> Picture:
    """Draw responses of many plants: the band that holds 98 % of them, all of them, and when they settle."""
    figure = picture(9.6, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    for response, style, name in ((free, _OPEN, "open loop"), (batch, MODELS[1], "closed loop")):
        if response is None:
            continue
        low, middle, high = np.quantile(1e3 * response.cart_position, (0.01, 0.5, 0.99), axis=1)
        if response is batch:
            worst = 1e3 * np.max(np.abs(response.cart_position), axis=1)
            left.fill_between(response.time, -worst, worst, color="0.92", linewidth=0, label="all")
            left.fill_between(response.time, low, high, color="0.7", linewidth=0, label="98 % of plants")
        left.plot(response.time, middle, label=f"median, {name}", **style)
    left.set_xlabel("Time [s]", fontsize=SMALL)
    left.set_ylabel("Cart position [mm]", fontsize=SMALL)
    left.legend(fontsize=SMALL, loc="upper right")
    tidy(left)
    settled = batch.settling_time()
    top = float(batch.time[-1])
    bins = np.linspace(0, top, 81)
    for response, hatch, colour, name in ((free, "///", "white", "open loop"), (batch, "", "0.45", "closed loop")):
        if response is not None:
            times = np.minimum(response.settling_time(), top - 1e-9)
            right.hist(times, bins=bins, color=colour, hatch=hatch, edgecolor="0.3", linewidth=0.4, label=name)
    right.axvline(within, label=f"{within:.3g} s", **_BOUND)
    right.set_xlabel("Time until under a tenth [s]", fontsize=SMALL)
    right.set_ylabel("Plants", fontsize=SMALL)
    right.legend(fontsize=SMALL)
    tidy(right)
    title(
        figure,
        f"{100 * np.mean(batch.holds(within=within)):.1f} % of {len(settled)} plants settle within {within:.3g} s "
        f"without winding up the arm",
    )
    return figure


def _band(synthesis: Synthesis) -> tuple[float, float]:
    """Return a decade and a half on either side of the sensitivity's deepest place."""
    centre = float(synthesis.frequency[np.argmin(np.abs(synthesis.sensitivity))])
    return centre / 30, 30 * centre


def _seconds(value: float) -> str:
    return f"{value:.2f} s" if np.isfinite(value) else "never in this record"
