"""Table 1 of the paper, in its form: estimates from free and from forced oscillation, and the rig's parameters."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from estimators.closed_form.two_stage import Estimates, Weighting
from estimators.closed_form.unknown_scale import SCALING
from estimators.core.drawing import draw
from estimators.core.result_base import Result
from rtac_jax import RTAC
from rtac_jax.overview import Overview, aligned

CONSISTENT = 0.3
SYMBOLS = {
    "eccentric_moment": "me",
    "torque_constant": "K_m",
    "arm_viscous.positive": "K_v1",
    "arm_viscous.negative": "K_v2",
}


class Printed(NamedTuple):
    """A mean of Table 1 and its standard deviation over experiments, divided by the mean."""

    mean: float
    consistency: float


PAPER: Mapping[str, Printed] = {
    "(M+m)/k": Printed(9.27e-3, 0.0064),
    "v/k": Printed(4.18e-3, 0.0968),
    "d/k": Printed(1.81e-4, 0.1474),
    "eccentric_moment": Printed(1.06e-3, 0.155),
    "torque_constant": Printed(8.04e-2, 0.062),
    "arm_viscous.positive": Printed(1.39e-4, 0.34),
    "arm_viscous.negative": Printed(1.49e-4, 0.33),
}
"""Table 1(a) and (b) as the paper prints them, for its real rig; SI units."""


@dataclasses.dataclass(frozen=True)
class ClosedFormOptions:
    """The options of closed-form estimates; see the arguments of `least_squares`."""

    weak: bool
    instruments: bool
    reaction: bool
    weighting: Weighting
    cutoff: float | None
    near_zero: float


@dataclasses.dataclass(frozen=True, repr=False)
class ClosedForm(Result):
    """The result of `least_squares`.

    Attributes:
        model: the model with these estimates.
        ratios: (M+m)/k, v/k and d/k from free oscillation, Table 1(a).
        estimates: parameters in SI units, by name; Table 1(b) and (c).
        cutoff: of the low-pass filter, per experiment [Hz]; empty for the weak form.
        skipped: why an experiment was not used, by name.
        options: how the estimates were made.
        weak: the estimates of the weak form from the same recording, where these are of filtered measurements: for
            comparison, as noise in the regressors biases v and d of these.
        angles: of the arm at the start [rad], of experiments that do not tell it, found together with the eccentric moment.
        assumed: which of total mass and arm inertia is the model's own value, since nothing that was measured tells it.
    """

    model: RTAC
    ratios: Mapping[str, Estimates]
    estimates: Mapping[str, Estimates]
    cutoff: Mapping[str, float]
    skipped: Mapping[str, str]
    options: ClosedFormOptions
    weak: "ClosedForm | None" = None
    assumed: tuple[str, ...] = ()
    angles: Mapping[str, float] = dataclasses.field(default_factory=dict)

    @property
    def consistent(self) -> bool:
        """Return whether every estimate scatters over the experiments by less than 30 % of its mean, the paper's rule."""
        known = [e.consistency for e in {**self.ratios, **self.estimates}.values() if np.isfinite(e.consistency)]
        return bool(known) and all(c < CONSISTENT for c in known)

    @property
    def reversed_drive(self) -> str:
        """Say that the motor turns against its current, for which other estimators have no sign; nothing where it does not."""
        found = self.estimates.get("torque_constant")
        if found is None or not found.value < 0 or abs(found.value) < 2 * np.nan_to_num(found.std):
            return ""
        return (
            f"In closed form torque_constant is {found.value:.4g} {found.unit}, and it cannot be negative, so that fits end near "
            "zero: doubt the sign of the current first, or that of angle and velocity (--scale of rtac import, or swap two wires)."
        )

    def overview(self) -> Overview:
        """Return the estimates of parameters, with their scatter over experiments."""
        rows = [(n, f"{e.value:.5g}", _spread(e), _percent(e.consistency), e.unit) for n, e in self.estimates.items()]
        title = (
            f"{len(rows)} parameters in closed form, {'' if self.consistent else 'not '}consistent by the paper's rule"
        )
        notes = [f"{name} is the model's own value" for name in self.assumed]
        return Overview(title, ("parameter", "mean", "std", "scatter / mean", "unit"), rows, notes)

    def __str__(self) -> str:
        return table_1(self)

    def plot(self) -> Any:
        """Draw the estimates from each experiment, as a matplotlib figure."""
        return draw(self)


def table_1(found: ClosedForm) -> str:
    """Return Table 1(a), (b) and (c) of these estimates as text, with the paper's rule on consistency."""
    forced = {SYMBOLS[n]: found.estimates[n] for n in SYMBOLS if n in found.estimates}
    parts = []
    for letter, kind, columns in (("a", "free", found.ratios), ("b", "forced", forced)):
        if not columns:
            parts.append(f"({letter}) {kind} oscillation: no experiment that serves")
            continue
        if (inertia := columns.get("(M+m)/k")) is not None and inertia.value <= 0:
            parts.append(
                f"({letter}) {kind} oscillation: the data show no spring, so there are no ratios to its stiffness"
            )
            continue
        count = max(len(e.each) for e in columns.values())
        rows = [
            ["", *(f"{n} [{e.unit}]" for n, e in columns.items())],
            ["Mean", *(f"{e.value:.4g}" for e in columns.values())],
            ["Std.dev. / Mean", *(_percent(e.consistency) for e in columns.values())],
            ["Std.dev. of mean", *("" if np.isnan(e.std) else f"{e.std:.2g}" for e in columns.values())],
        ]
        parts.append(f"({letter}) {kind} oscillation, {count} experiment{'s' * (count != 1)}\n{_table(rows)}")
    coupling = float(np.asarray(found.model.body.coupling()))
    rows = [["Coupling parameter", "epsilon", f"{coupling:.4g}", ""]]
    places = ("Total mass", "total_mass"), ("Arm inertia", "arm_inertia"), ("Spring stiffness", "spring_stiffness")
    others = tuple((found.model.parameters[n].meaning.capitalize(), n) for n in found.estimates)
    for title, name in dict.fromkeys((*places, *(o for o in others if o[1] not in dict((b, a) for a, b in places)))):
        declared = found.model.parameters[name]
        told = bool(found.ratios) or name in {*found.estimates, *found.assumed, *found.model.fixed}
        rows.append([title, declared.symbol, f"{_value(found, name):.5g}" if told else "not told", declared.unit])
    parts.append(f"(c) parameters of the rig, from all experiments together\n{_table(rows)}")
    return "\n\n".join(
        [
            *parts,
            *_disregarded(found),
            *_assumed(found),
            *_angles(found),
            *_taken_as_known(found),
            *_bias(found),
            _rule(found),
        ]
    )


def _value(found: ClosedForm, name: str) -> float:
    """Return an estimate, or the model's value where there is none; one beyond its bounds, which no model can have, as it is."""
    own = float(np.mean(np.asarray(found.model[name])))
    estimate = found.estimates[name].pooled if name in found.estimates else own
    low, high = found.model.parameters[name].bounds
    return estimate if estimate <= low or estimate >= high else own


def _disregarded(found: ClosedForm) -> list[str]:
    """Say which effects of the model equations (5) and (6) do not have."""
    others = [effect for effect in found.model.ids if effect not in _IN_EQUATIONS]
    if not others:
        return []
    return [
        f"Equations (5) and (6) have no {', '.join(others)}: these estimates are as if the model had none, and what "
        "it does shows in the others. An estimator that fits the whole model is est.output_error."
    ]


def _angles(found: ClosedForm) -> list[str]:
    """Say which angles of the arm nobody measured, and what they were found to be."""
    if not found.angles:
        return []
    each = ", ".join(f"{name} {angle:.2f} rad" for name, angle in found.angles.items())
    return [f"Where the arm begins was not measured; it was found from how it pushes the cart: {each}."]


def _taken_as_known(found: ClosedForm) -> list[str]:
    """Say which constant the stiffness rests on, whose error the scatter over experiments cannot show."""
    name = "eccentric_moment"
    if not found.ratios or not found.options.reaction or name in found.estimates or name not in found.model.parameters:
        return []
    value = float(np.mean(np.asarray(found.model[name])))
    return [
        f"me is taken as {value:.4g} kg m, since no forced experiment tells it. An error in it shifts the stiffness of all "
        "experiments alike, which their scatter, and so the standard deviation, does not show."
    ]


_IN_PROPORTION = {
    "total_mass": ("spring_stiffness", "cart_viscous.coefficient", "cart_coulomb.level"),
    "arm_inertia": ("eccentric_moment", "torque_constant", "arm_viscous.positive", "arm_viscous.negative"),
}


def _assumed(found: ClosedForm) -> list[str]:
    """Say which constant is nothing but the model's own value, and what is wrong by the same factor."""
    said = []
    for name in found.assumed:
        value, declared = float(np.mean(np.asarray(found.model[name]))), found.model.parameters[name]
        alike = _IN_PROPORTION[name]
        if name == "total_mass" and not SCALING & found.model.fixed and "arm_inertia" in found.estimates:
            alike += ("arm_inertia", *_IN_PROPORTION["arm_inertia"])  # its inertia follows from the mass
        scaled = [found.model.parameters[n].symbol for n in alike if n in found.estimates]
        wrong = f" {', '.join(scaled)} are in proportion to it, and wrong by as much as it is." if scaled else ""
        said.append(
            f"{declared.symbol} is not estimated: {value:.4g} {declared.unit} is the value that the model began with, as neither a "
            f"constant of the rig nor the motion of cart and arm together tells it.{wrong} Give {name}, if you know it."
        )
    return said


_IN_EQUATIONS = ("cart_viscous", "cart_coulomb", "arm_viscous")
_SECOND_STAGE = ("eccentric_moment", "torque_constant", "arm_viscous.positive", "arm_viscous.negative")


def _bias(found: ClosedForm) -> list[str]:
    """State the bias of filtered measurements, and the weak form beside them."""
    if found.options.weak or not found.ratios:
        return []
    said = [
        "v and d are biased here: the regressors are filtered and differentiated measurements, and hold their noise. On a rig "
        "like the paper's v is 8 to 17 % too large, 3.5 to 14 of the standard deviations stated above, at the cost of d; with "
        "more noise, or little dry friction, it may be half or twice as large. What scatters little can be off all the same. "
        "least_squares(..., weak=True) has no such bias."
    ]
    if found.weak is not None:
        here, there = (({**f.ratios, **f.estimates}) for f in (found, found.weak))
        rows = [["", "unit", "as above", "std", "weak form", "std", "difference"]]
        for name in (*found.ratios, *(n for n in _SECOND_STAGE if n in here)):
            if name in there:
                one, other = here[name], there[name]
                rows.append(
                    [SYMBOLS.get(name, name), one.unit, f"{one.value:.4g}", _spread(one), f"{other.value:.4g}", _spread(other),
                     f"{100 * (one.value / other.value - 1):+.1f} %" if other.value else ""]
                )  # fmt: skip
        said.append(f"beside the weak form\n{_table(rows)}")
    return said


def _spread(one: Estimates) -> str:
    return "" if np.isnan(one.std) else f"{one.std:.2g}"


def _rule(found: ClosedForm) -> str:
    every = {n: e.consistency for n, e in {**found.ratios, **found.estimates}.items()}
    known = {n: c for n, c in every.items() if np.isfinite(c)}
    if not known:
        return "One experiment of a kind has no scatter: record several to judge consistency."
    single = [SYMBOLS.get(n, n) for n in every if n not in known]
    alone = f" Of {', '.join(single)} nothing is said: one experiment has no scatter." if single else ""
    loose = [f"{SYMBOLS.get(n, n)} ({_percent(c)})" for n, c in known.items() if not c < CONSISTENT]
    if loose:
        return f"Not consistent by the paper's rule of 30 %: {', '.join(loose)}.{alone}"
    which = "the other" if single else "all"
    scatter = f"Consistent by the paper's rule: {which} standard deviations are below 30 % of their means."
    judged = "whether the model is right" if found.options.weak else "bias"
    return f"{scatter} That judges scatter, not {judged}.{alone}"


def _percent(fraction: float) -> str:
    return "" if np.isnan(fraction) else f"{100 * fraction:.3g} %"


def _table(rows: list[list[str]]) -> str:
    return "\n".join(aligned(rows, right=range(1, len(rows[0]))))
