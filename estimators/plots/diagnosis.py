"""The missing effect: the candidates beside each other, and the missing force as a curve and in time."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.missing_force import static_force
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.ranking import ranked
from estimators.misspecification.static_force import ForceCurve
from estimators.plots.effect_curve import effect_curve
from estimators.plots.style import (
    MODELS,
    NAMES,
    SMALL,
    UNITS,
    Picture,
    picture,
    prefixed,
    quantity,
    tidy,
    times,
    title,
    worst_stretch,
)
from estimators.prediction_error.latent_force import LatentForce
from rtac_jax.measurement import Recording

_MOST_BARS = 14
_NEAR = 0.05  # fraction of the misfit that makes a rival worth naming
_FORCE = {"cart": ("force", "N"), "arm": ("torque", "N m")}
_ALWAYS = ("cart_position", "cart_velocity", "arm_angle")


def plot_diagnosis(diagnosis: Diagnosis, *, recording: Recording | None = None) -> Picture:
    """Draw the scores of the candidates with what would have been found of each, and the missing force as curves.

    The curves are those of the port where most is missing: against position, velocity and angle, as far as the data have
    them, and against what the force depends on most. Where no effect of the catalogue explains what is missing, the
    missing force is also drawn in time.

    Args:
        diagnosis: to be drawn.
        recording: that was diagnosed, for the time axis of that force; without it samples are counted.
    """
    latent = diagnosis.latent[0] if diagnosis.verdict == "unknown" and diagnosis.latent else None
    always, other = _chosen(diagnosis)
    beside = (latent is not None) + (other is not None)
    tall = beside > 1
    figure = picture(9.6, (8.4 if tall else 7.2) if always else 6.2)
    rows = figure.add_gridspec(2 if always else 1, 1, height_ratios=[1.8 if tall else 1.3, 1] if always else [1])
    top = rows[0].subgridspec(max(beside, 1), 2 if beside else 1, width_ratios=[1.15, 1] if beside else [1])
    _bars(figure.add_subplot(top[:, 0]), diagnosis, wide=not beside)
    # One scale for all, so that one sees which variable the force depends on.
    reach = _reach([curve for curve in (*always, other) if curve is not None])
    if latent is not None:
        _in_time(figure.add_subplot(top[0, 1]), latent, recording)
    if other is not None:
        _curve(figure.add_subplot(top[-1, 1]), other, diagnosis, reach, narrow=False, keyed=not always)
    if always:
        below = rows[1].subgridspec(1, len(always))
        for column, curve in enumerate(always):
            _curve(figure.add_subplot(below[column]), curve, diagnosis, reach, narrow=True, keyed=column == 0)
    title(figure, finding(diagnosis))
    return figure


def finding(diagnosis: Diagnosis) -> str:
    """Say the verdict in one line, with the numbers that carry it."""
    accepted = diagnosis.effects
    if diagnosis.simulation is not None and diagnosis.simulation.words:
        return diagnosis.simulation.headline
    if diagnosis.verdict == "adequate":
        tried, count = len(diagnosis.candidates), sum(c.testable for c in diagnosis.candidates)
        in_time = ", as far as was asked in time" if diagnosis.broken_off else ""
        return (
            f"Nothing is missing {diagnosis.floor}{in_time}: none of {tried} candidates ({count} testable) stands out"
        )
    if diagnosis.silent:
        return diagnosis.silent
    if diagnosis.verdict == "unknown":
        if diagnosis.drift:
            return f"The model fails as where a parameter drifts: {diagnosis.drift.split(' would explain')[0]}"
        failed = f"The model fails, and {diagnosis.no_effect} explains it"
        if not diagnosis.curves:
            return failed
        best, rejected = static_force(diagnosis.curves, diagnosis.tests, diagnosis.policy)
        if best is None:
            what = "is for the most part no function" if rejected else "is no function"
            return f"{failed}; what is missing on the {_deficient(diagnosis)} {what} of position, velocity or angle"
        return f"{failed}; what is missing on the {best.port} depends most on {NAMES[best.variable]}"
    best = accepted[0]
    fraction = (
        f"{100 * (diagnosis.removed if diagnosis.by_simulation else best.error_reduction):.0f} % of {diagnosis.misfit}"
    )
    groups: list[list[str]] = []
    for c in accepted:
        if (group := sorted({c.id, *c.confusable_with})) not in groups:
            groups.append(group)
    if len(groups) > 1:
        named = " and ".join(f"({' or '.join(group)})" if len(group) > 1 else group[0] for group in groups)
        unclear = ", but the data leave open which of a group" if diagnosis.verdict == "ambiguous" else ""
        return f"{named} together explain {100 * diagnosis.removed:.0f} % of {diagnosis.misfit}{unclear}"
    if diagnosis.verdict == "ambiguous":
        others = ", ".join(c.id for c in accepted[1:])
        return f"{best.id} explains {fraction}, but the data cannot tell it from {others}"
    if diagnosis.by_simulation:
        return f"{best.id} explains {fraction}"
    rest = [
        c
        for c in diagnosis.candidates
        if c.id not in {a.id for a in accepted} and c.chi_square > diagnosis.policy.alarm
    ]
    rest = [c for c in rest if c.refitted and c.error_reduction > _NEAR]
    if not rest:
        return f"{best.id} explains {fraction}; nothing else comes near"
    second = max(rest, key=lambda c: (c.bic_gain, c.score))
    return f"{best.id} explains {fraction}; the next, {second.id}, {100 * second.error_reduction:.0f} %"


def _alarms(c: Candidate, policy: DiagnosisPolicy) -> bool:
    """Return whether a candidate rejects: it is large, and not by the scatter of a few seconds."""
    return c.chi_square >= policy.alarm and c.p_value < policy.chance


def _bars(axes: Axes, diagnosis: Diagnosis, *, wide: bool) -> None:
    accepted, policy = {c.id for c in diagnosis.effects}, diagnosis.policy
    shown = sorted(ranked(diagnosis)[:_MOST_BARS], key=lambda c: (c.id not in accepted, -c.chi_square))
    left = len(diagnosis.candidates) - len(shown)
    top = max([c.chi_square for c in shown] + [2 * policy.alarm])
    for row, c in enumerate(shown):
        axes.barh(
            row, c.chi_square, height=0.62, edgecolor="black", linewidth=0.6,
            color="#08306b" if c.id in accepted else "0.8" if _alarms(c, policy) else "0.95",
            hatch="///" if _alarms(c, policy) and c.id not in accepted else "",
        )  # fmt: skip
        axes.annotate(
            _remark(c, c.id in accepted, diagnosis), (1.0, row), xycoords=("axes fraction", "data"), xytext=(-2, 0),
            textcoords="offset points", ha="right", va="center", fontsize=7.5,
            fontweight="bold" if c.id in accepted else "normal",
        )  # fmt: skip
    axes.axvline(policy.alarm, color="black", linestyle="--", linewidth=1)
    axes.set_xscale("symlog", linthresh=policy.alarm, linscale=0.6)
    # The remarks stand to the right of the longest bar.
    decades = np.log10(top / policy.alarm)
    axes.set_xlim(0, policy.alarm * 10 ** (1.35 * decades + 0.6 if wide else 2.1 * decades + 1.2))
    axes.set_xticks(*_ticks(top, policy.alarm))
    axes.minorticks_off()
    names = [f"{'★ ' if c.id in accepted else ''}{c.id}" for c in shown]
    axes.set_yticks(range(len(shown)), names)
    axes.set_ylim(len(shown) - 0.4, -1.1)
    axes.text(policy.alarm, -0.62, f" alarm: chi-square {policy.alarm:g}", fontsize=7.5, ha="left", va="center")
    axes.set_xlabel("Chi-square gained by the candidate alone [1]", fontsize=SMALL)
    more = f"best {len(shown)} candidates, {left} more score lower" if left else f"all {len(shown)} candidates"
    marked = "★ and dark: accepted" if accepted else "none accepted"
    if any(_alarms(c, policy) and c.id not in accepted for c in shown):
        marked += "; hatched: alarm"
    axes.set_title(f"{more};\n{marked}", fontsize=9, loc="left")
    tidy(axes)
    axes.grid(False, axis="y")


def _ticks(top: float, alarm: float) -> tuple[list[float], list[str]]:
    found = [0.0, alarm]
    found += [10.0**n for n in range(2, int(np.log10(top)) + 2) if 10.0**n <= 3 * top]
    step = 1 + len(found) // 6
    found = [*found[:2], *found[2::step]]
    return found, [f"{value:g}" if value < 1e4 else f"$10^{{{np.log10(value):.0f}}}$" for value in found]


def _remark(c: Candidate, accepted: bool, diagnosis: Diagnosis) -> str:
    policy = diagnosis.policy
    if diagnosis.by_simulation and accepted:
        return "accepted by simulation"
    if diagnosis.by_simulation and c.refitted:
        return f"predictions alone gain {100 * c.error_reduction:.0f} %"
    if c.refitted and not accepted:
        return f"when fitted, removes {100 * c.error_reduction:.0f} %"
    if accepted:
        return f"removes {100 * c.error_reduction:.0f} % of the misfit"
    if not c.limit:
        return c.limit_or_why
    if c.chi_square >= policy.alarm and not _alarms(c, policy):
        return f"no alarm: by its scatter p = {c.p_value:.1g}"
    return f"would show from {c.limit if c.unit == '1' else quantity(c.detection_limit, c.unit)}"


def _chosen(diagnosis: Diagnosis) -> tuple[list[ForceCurve], ForceCurve | None]:
    """Return curves of the deficient port against position, velocity and angle, and the best one where it is another."""
    if not diagnosis.curves:
        return [], None
    best, port = diagnosis.curves[0], _deficient(diagnosis)
    own = {curve.variable: curve for curve in diagnosis.curves if curve.port == port}
    always = [own[variable] for variable in _ALWAYS if variable in own]
    return always, best if best.port == port and best.variable not in _ALWAYS else None


def _deficient(diagnosis: Diagnosis) -> str:
    """Return the port where most is missing.

    By the curves or, where what is missing is no function of them, by what was found.
    """
    best = diagnosis.curves[0]
    if _beyond_chance(best, diagnosis):
        return best.port
    found = [force.port for force in diagnosis.latent] + [effect.port for effect in diagnosis.additions]
    return next((port for port in found if port in _FORCE), best.port)


def _beyond_chance(curve: ForceCurve, diagnosis: Diagnosis) -> bool:
    """Return whether a curve explains more than the best of all curves does by chance."""
    level = min((test.level for test in diagnosis.tests if test.test == "static force"), default=0.0)
    return curve.p_value * len(diagnosis.curves) < level


def _in_time(axes: Axes, latent: LatentForce, recording: Recording | None) -> None:
    """Draw the missing force over the experiment that carries most of it, or its strongest stretch."""
    most = max(latent.by_experiment, key=lambda name: latent.by_experiment[name])
    column = latent.experiments.index(most)
    force, std = latent.force[:, column], latent.std[:, column]
    known = np.isfinite(force)
    force, std = force[known], std[known]
    near = worst_stretch(force)
    force, std = force[near], std[near]
    scale = prefixed(float(np.max(np.abs(force) + 2 * std, initial=0.0)), latent.unit)
    step = recording[most].sample_time if recording is not None and most in recording.names else None
    at = np.arange(near.start, near.start + len(force)) * (1.0 if step is None else step)
    axes.fill_between(
        at,
        scale.factor * (force - 2 * std),
        scale.factor * (force + 2 * std),
        color="0.78",
        linewidth=0,
        label="±2 std",
    )
    axes.plot(at, scale.factor * force, color="#08306b", linewidth=0.9, label="missing")
    axes.axhline(0, color="black", linewidth=0.6)
    what, _ = _FORCE[latent.port]
    axes.set_xlabel("Sample [1]" if step is None else "Time [s]", fontsize=SMALL)
    axes.set_ylabel(f"{what.capitalize()} on the {latent.port} [{scale.unit}]", fontsize=SMALL)
    axes.set_title(
        f"{what} missing on the {latent.port} in {most}, most at {latent.frequency:.2g} rad/s", fontsize=9, loc="left"
    )
    tidy(axes)
    axes.legend(fontsize=7, loc="best")


def _reach(curves: Sequence[ForceCurve]) -> float:
    """Return the largest force with its band that any curve tells from nothing; of all of them where none tells one.

    At the ends of its range a variable is seldom, and a band there is too wide to show; so is that of a curve whose slope is the
    model's own.
    """

    def largest(curve: ForceCurve, *, told: bool) -> float:
        shown = curve.std <= 6 * np.median(curve.std[np.isfinite(curve.std)])
        if told:
            shown &= np.abs(curve.force) > 2 * curve.std
        return float(np.max(np.abs(curve.force[shown]) + 2 * curve.std[shown], initial=0.0))

    tried = (max((largest(curve, told=told) for curve in curves), default=0.0) for told in (True, False))
    return next((reach for reach in tried if reach > 0), 1.0)


def _curve(axes: Axes, curve: ForceCurve, diagnosis: Diagnosis, reach: float, *, narrow: bool, keyed: bool) -> None:
    what, unit = _FORCE[curve.port]
    across = prefixed(float(np.max(np.abs(curve.at))), UNITS[curve.variable])
    up = prefixed(reach, unit)
    x = across.factor * curve.at
    force = np.where(np.isfinite(curve.std), curve.force, np.nan)
    low, high = (up.factor * (force + sign * 2 * curve.std) for sign in (-1, 1))
    axes.fill_between(x, low, high, color="0.82", linewidth=0, label="±2 std")
    axes.plot(x, up.factor * force, color="#08306b", marker="o", markersize=3, linewidth=1.2, label="missing")
    drawn = 0
    for effect in diagnosis.additions:
        if (shape := effect_curve(effect, curve)) is not None:
            style = {**(MODELS[0], *MODELS[2:])[drawn], "linewidth": 1.6}
            axes.plot(shape[0] * across.factor, shape[1] * up.factor, label=f"{effect.id}, fitted", **style)
            drawn += 1
    axes.axhline(0, color="black", linewidth=0.6)
    axes.set_ylim(-1.2 * up.factor * reach, 1.2 * up.factor * reach)
    name = NAMES[curve.variable]
    axes.set_xlabel(f"{name[0].upper()}{name[1:]} [{across.unit}]", fontsize=SMALL)
    axes.set_ylabel(f"{what.capitalize()} on the {curve.port} [{up.unit}]", fontsize=SMALL)
    told = _beyond_chance(curve, diagnosis)
    explains = f"explains chi-square {times(max(curve.explains, 0.0))}" if told else "nothing beyond chance"
    apart = "\n" if narrow or "," in name else " "
    axes.set_title(f"against {name}:{apart}{explains}", fontsize=9, loc="left")
    tidy(axes)
    if keyed or drawn:
        axes.legend(fontsize=7, loc="best")
