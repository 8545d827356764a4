"""The next experiment: of those that the rig can do, the one that best tells apart what the data leave open."""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any

import numpy as np
from jaxtyping import Float

from estimators.core.data import moving
from estimators.core.drawing import draw
from estimators.core.fit import Fit
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.experiment_design.candidate_experiments import (
    Limits,
    coasts,
    default_plans,
    feasible,
    held_alike,
    predicted,
)
from estimators.experiment_design.hypotheses import contest_of
from estimators.experiment_design.t_optimality import separations
from rtac_jax import require_configured
from rtac_jax.arguments import checked_arguments
from rtac_jax.effects import Effect
from rtac_jax.measurement import DESIGNED, OUTPUTS, Plan, Recording

CONFUSABLE = 10.0
"""Separation below which two effects are not told apart."""

ENOUGH = 500.0
"""Separation beyond that of the recording, above which more decides nothing more: the gentler experiment comes first."""

HOPELESS = 0.5
"""Separation that the best experiment adds, below which twenty repeats of it would not do, so that none is worth recording."""
_NOTHING = 1e-3  # separation that is printed as none: a thousand times as much would decide nothing

Pair = tuple[str, str]


@dataclasses.dataclass(frozen=True)
class PlannedExperiment:
    """One experiment of the candidate set.

    Attributes:
        plan: what to do; `rtac_jax.virtual_rig.record` can do it too.
        separation: twice the expected gain in log-likelihood of the first effect of a pair, if it is the truth, over the
            second at its best values, from the recording and this experiment together; by pair.
        travel: of the cart to each side, as the model predicts [m].
        torque: largest [N m].
        speed: of the arm, largest [rad/s].
        effort: the largest of these as a fraction of its limit [1].
    """

    plan: Plan
    separation: Mapping[Pair, float]
    travel: float
    torque: float
    speed: float
    effort: float

    @property
    def smallest(self) -> float:
        """Return the separation of the pair that it separates least."""
        return min(self.separation.values())


@dataclasses.dataclass(frozen=True)
class NextExperiment:
    """The result of `next_experiment`.

    Attributes:
        effects: ids of those to be told apart.
        already: separation of each pair by the recording alone.
        ranked: experiments within the limits, best first.
        refused: why the others are not among them.
        recording: the recommended experiment as a file to play: its inputs, and as outputs what the model predicts.
        held_out: smallest separation by the recording and each experiment that was held out of it, by name.
        untold: pairs that none of them tells apart, be it repeated twenty times, where others are: they are not ranked by these.
    """

    effects: tuple[str, ...]
    already: Mapping[Pair, float]
    ranked: tuple[PlannedExperiment, ...]
    refused: tuple[str, ...]
    recording: Recording
    held_out: Mapping[str, float] = dataclasses.field(default_factory=dict)
    untold: tuple[Pair, ...] = ()

    @property
    def deciding(self) -> tuple[str, ...]:
        """Return the experiments that were held out and would tell the effects apart, had they been fitted."""
        if min(self.already.values()) >= CONFUSABLE:
            return ()
        return tuple(name for name, separation in self.held_out.items() if separation >= CONFUSABLE)

    @property
    def spared(self) -> str:
        """Say which experiments that were held out would decide; empty where none would."""
        if not self.deciding:
            return ""
        names = " and ".join(f"{name} ({self.held_out[name]:.3g})" for name in self.deciding)
        return (
            f"It may not be needed: of what was held out, {names} would tell these apart if it were fitted. Hold out others "
            "(validation, --validation)."
        )

    @property
    def hopeless(self) -> str:
        """Say that no experiment tells any of the effects apart that are not told apart yet; empty where one may, or would have."""
        added = {
            pair: max(one.separation[pair] for one in self.ranked) - before
            for pair, before in self.already.items()
            if before < CONFUSABLE
        }
        if not added or max(added.values()) >= HOPELESS or self.deciding:
            return ""
        most = max(self.already[pair] + more for pair, more in added.items())
        return (
            f"No next experiment: none of {len(self.ranked)} within the limits tells {self.told_apart} apart, be it repeated"
            f" twenty times (separation {most:.2g} at most; below {CONFUSABLE:g} effects are not told apart). What they stand for"
            " has to be measured by itself, as by weighing, or by calibrating a sensor."
        )

    @property
    def best(self) -> PlannedExperiment:
        """Return the recommended experiment."""
        return self.ranked[0]

    @property
    def told_apart(self) -> str:
        """Return the effects in words: one from its rivals, or all from each other."""
        pairs = list(self.already)
        sure = next((i for i in self.effects if len(self.effects) > 2 and all(i in pair for pair in pairs)), None)
        if sure is None:
            return " and ".join(self.effects)
        return f"{sure} from {' and '.join(i for i in self.effects if i != sure)}"

    @property
    def plan(self) -> Plan:
        """Return the plan of the recommended experiment."""
        return self.best.plan

    @property
    def current(self) -> Float[np.ndarray, " sample"]:
        """Motor current of the recommended experiment [A]; zero in a free decay."""
        plan = self.plan
        return np.zeros(plan.samples) if plan.current is None else plan.current

    def save(self, path: str | PathLike[str]) -> None:
        """Write the recommended experiment for the rig, ".csv" or ".h5"; see `Recording.save`."""
        self.recording.save(path)

    def as_dict(self, most: int = 5) -> dict[str, Any]:
        """Return the recommendation and the experiments next to it, for a report; SI units."""
        plan = self.plan

        def pairs(separation: Mapping[Pair, float]) -> list[dict[str, Any]]:
            return [{"true": i, "against": j, "separation": value} for (i, j), value in separation.items()]

        return {
            "name": plan.name,
            "kind": plan.kind,
            "effects": list(self.effects),
            "separation": pairs(self.best.separation),
            "separation_already": pairs(self.already),
            "sample_time": plan.sample_time,
            "duration": plan.duration,
            "initial_position": plan.initial_position,
            "initial_arm_angle": plan.initial_angle,
            "travel": self.best.travel,
            "torque": self.best.torque,
            "arm_speed": self.best.speed,
            "held_out": dict(self.held_out),
            "ranked": [{"name": one.plan.name, "smallest_separation": one.smallest} for one in self.ranked[:most]],
        }

    def __str__(self) -> str:
        if self.hopeless:
            return self.hopeless
        best, plan = self.best, self.plan
        worst = min(best.separation, key=lambda pair: best.separation[pair])
        lines = [
            f"Next experiment: {plan.name}, {plan.duration:g} s, {_begun(plan)}.",
            f"It raises the smallest separation of {self.told_apart} from {_separation(min(self.already.values()))} to "
            f"{_separation(best.smallest)} ({worst[0]} against {worst[1]}); below {CONFUSABLE:g} effects are not told apart.",
            f"Predicted: travel {1e3 * best.travel:.2g} mm, torque {best.torque:.2g} N m, current "
            f"{np.max(np.abs(self.current)):.2g} A, arm {best.speed:.3g} rad/s.",
        ]
        if min(self.already.values()) >= CONFUSABLE:
            lines.append(
                "By these models the recording tells these apart already, and nothing new has to be recorded for that: where the"
                " diagnosis does not tell them apart even so, both may stand for something else."
            )
        elif best.smallest < CONFUSABLE:
            lines.append(
                "No experiment that was tried tells these apart; record it several times, or widen the limits."
            )
        if self.untold:
            pairs = " or ".join(f"{i} from {j}" for i, j in self.untold)
            lines.append(f"None of them tells {pairs}, so they are ranked by the others.")
        if self.deciding:
            lines.append(self.spared)
        if max(one.smallest for one in self.ranked) > best.smallest:
            lines.append(f"Of experiments that add more than {ENOUGH:g} the gentlest for the rig comes first.")
        wide = max(10, *(len(one.plan.name) for one in self.ranked))
        lines += ["", f"{'experiment':{wide}s} {'separation':>11s} {'travel':>9s} {'torque':>11s} {'arm speed':>11s}"]
        lines += [
            f"{one.plan.name:{wide}s} {_separation(one.smallest):>11s} {1e3 * one.travel:6.2f} mm {1e3 * one.torque:6.2f} mN m "
            f"{one.speed:5.1f} rad/s"
            for one in self.ranked
        ]
        return "\n".join([*lines, *(f"refused: {reason}" for reason in self.refused)])

    def plot(self) -> Any:
        """Draw the separation by every experiment, and the recommended one, as a matplotlib figure."""
        return draw(self)


def _begun(plan: Plan) -> str:
    """Say how an experiment begins."""
    cart = (
        "the cart clamped" if plan.cart == "clamped" else f"the cart released at {1e3 * plan.initial_position:.3g} mm"
    )
    turning = f", turning at {plan.initial_arm_velocity:.3g} rad/s" if plan.initial_arm_velocity else ""
    return f"{cart}, the arm at {plan.initial_angle:.3g} rad{turning}"


def _separation(size: float) -> str:
    """Return a separation in words; one that is next to nothing is rounding."""
    return f"{size:.3g}" if size >= _NOTHING else "0"


@checked_arguments
def next_experiment(
    fit: Fit,
    recording: Recording,
    found: Diagnosis,
    *,
    between: Sequence[str] | None = None,
    plans: Sequence[Plan] | None = None,
    candidates: Sequence[type[Effect]] | None = None,
    travel: float = 0.015,
    torque_limit: float = 0.1,
    speed_limit: float = 55.0,
    current_limit: float | None = None,
    duration: float | None = None,
    held_out: Recording | None = None,
    progress: bool = True,
    menu: Sequence[Plan] | None = None,
) -> NextExperiment:
    """Choose the experiment that best tells apart the effects between which a diagnosis could not decide.

    For each pair the separation is |(I - P) (t_i - t_j)|^2, with t what an effect at its estimated size changes in the
    innovations, and P the projection on what the parameters of the model and of the second effect can change: twice the
    expected gain in log-likelihood with the noise as it is, which is that of the recording once the best effect is added.

    The recommended experiment has the largest smallest separation, together with the recording that exists. Of those that
    add more than `ENOUGH` it is the gentlest: a base model that fails by fifty times the noise, as under a violent
    excitation, leads the next diagnosis astray.

    Args:
        fit: of the base model to the recording.
        recording: that was fitted and diagnosed.
        found: the diagnosis of this fit.
        between: ids of the effects to tell apart, or of one, to be told from nothing; by default those that the diagnosis
            calls ambiguous, else what it found and the nearest rivals.
        plans: experiments to choose from; those that break a limit on the model are passed over. By default free decays,
            square waves, multisines, steady currents, steps and chirps, their currents lowered to the limits.
        candidates: classes of the effects, where they are not in the catalogue.
        travel: largest cart position to each side [m].
        torque_limit: largest |K_m i| [N m].
        speed_limit: largest speed of the arm [rad/s].
        current_limit: largest current of the amplifier [A]; by default the torque alone limits it.
        duration: of the experiments of the default candidate set [s]; by default as the longest of the recording, at most 20 s.
        held_out: experiments that were not fitted, of which one may tell the effects apart already.
        progress: show a bar.
        menu: old name of `plans`.

    Raises:
        ValueError: nothing is to be told apart, an effect is unknown, a limit is out of range, no experiment keeps to
            the limits, or the arm is locked in all and no plans are given.
        RuntimeError: JAX was not configured for double precision.

    Source: Atkinson and Fedorov, Biometrika 62 (1975), T-optimum design for discrimination, linearised at the estimates.
    """
    require_configured()
    limits = Limits(travel, torque_limit, speed_limit, current_limit)
    experiments = moving(recording)
    if plans is None and menu is None and all(e.arm == "locked" for e in experiments):
        raise ValueError(
            "the arm is locked in every experiment, and what is planned moves the rig by its motor; give plans of your own, or"
            " measure by itself what the effects stand for."
        )
    contest = contest_of(fit, recording, found, between=between, candidates=candidates, progress=progress)
    interval = min(e.sample_time for e in experiments)
    if menu is not None:
        warnings.warn("next_experiment: menu is called plans now.", DeprecationWarning, stacklevel=2)
        plans = menu
    own = plans is not None
    if plans is None:
        longest = min(max(e.samples * e.sample_time for e in experiments), 20.0)
        plans = default_plans(contest.truth, limits, sample_time=interval, duration=duration or longest)
        taken = {e.name for part in (recording, held_out) if part is not None for e in part.experiments}
        plans = held_alike(plans, experiments)
        driven = [
            e for part in (recording, held_out) if part is not None for e in part.experiments if "current" in e.inputs
        ]
        if (
            not driven and current_limit is None and "torque_constant" not in recording.rig
        ):  # no motor that anybody knows of
            undriven = [p for p in plans if p.current is None]
            plans = undriven or coasts(experiments, limits, sample_time=interval, duration=duration or longest)
        plans = [dataclasses.replace(p, name=f"{p.name}, once more") if p.name in taken else p for p in plans]
    _require_plans(plans, [e.name for e in experiments])
    channels = [c for c in OUTPUTS if any(c in e.outputs for e in experiments)]
    possible = feasible(contest.truth, plans, limits, lower=not own, channels=channels)
    if not possible.plans:
        raise ValueError("plans: no experiment keeps to the limits: " + "; ".join(possible.refused[:3]) + ".")
    planned = [predicted(plan, shown, channels) for plan, shown in zip(possible.plans, possible.shown, strict=True)]
    spared = [] if held_out is None else [e for e in held_out.experiments if e.kind != "rest"]
    already, with_each = separations(contest, experiments, possible.plans, [*planned, *spared])
    untold = _hopeless_pairs(already, with_each[: len(planned)])
    already, *with_each = ({p: s for p, s in one.items() if p not in untold} for one in (already, *with_each))
    with_spared = with_each[len(planned) :]
    gain = float(np.asarray(contest.truth["torque_constant"]))
    largest = limits.largest_current(gain)
    ranked = []
    for plan, shown, separation in zip(possible.plans, possible.shown, with_each[: len(planned)], strict=True):
        reach, speed = (float(np.max(np.abs(shown.states[x]))) for x in ("cart_position", "arm_velocity"))
        current = 0.0 if plan.current is None else float(np.max(np.abs(plan.current)))
        effort = max(reach / travel, current / largest, speed / speed_limit)
        ranked.append(PlannedExperiment(plan, separation, reach, gain * current, speed, effort))
    # Of an effect that was never fitted the size is a guess, and no separation is surely enough.
    fitted = all(c.refitted for c in found.candidates if c.id in contest.effects)
    enough = min(already.values()) + ENOUGH if fitted else np.inf
    ranked.sort(key=lambda one: (-min(one.smallest, enough), one.effort))
    best = next(e for e in planned if e.name == ranked[0].plan.name)
    comment = (
        f"Experiment to be played, to tell {' and '.join(contest.effects)} apart: the inputs are the design, the outputs are the "
        f"prediction of the model ({', '.join(contest.truth.ids)}), {DESIGNED}. Release the cart at "
        f"{1e3 * ranked[0].plan.initial_position:.4g} mm and the arm at {ranked[0].plan.initial_angle:.4g} rad."
    )
    playable = Recording((best,), recording.rig, recording.rig_name, comment)
    by_spared = {e.name: min(one.values()) for e, one in zip(spared, with_spared, strict=True)}
    return NextExperiment(contest.effects, already, tuple(ranked), possible.refused, playable, by_spared, untold)


def _hopeless_pairs(already: Mapping[Pair, float], with_each: Sequence[Mapping[Pair, float]]) -> tuple[Pair, ...]:
    """Return the pairs that no experiment tells apart, where it does others."""
    hopeless = [
        pair
        for pair, before in already.items()
        if before < CONFUSABLE and max(one[pair] for one in with_each) - before < HOPELESS
    ]
    return tuple(hopeless) if len(hopeless) < len(already) else ()


def _require_plans(plans: Sequence[Plan], taken: Sequence[str]) -> None:
    for plan in plans:
        if not isinstance(plan, Plan):
            raise ValueError(f"plans: {plan!r} is no plan; give rtac_jax.measurement.Plan(...).")
        if plan.arm == "locked" and plan.cart == "clamped":
            raise ValueError(
                f"plans: in {plan.name} the arm is locked and the cart clamped, so nothing moves; free one of them."
            )
    names = [plan.name for plan in plans]
    if not names:
        raise ValueError("plans: is empty; give at least one plan.")
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ValueError(f"plans: {', '.join(twice)} occurs twice; give each plan a name of its own.")
    known = sorted(set(names) & set(taken))
    if known:
        raise ValueError(f"plans: the recording has {', '.join(known)} already; rename the plan.")
