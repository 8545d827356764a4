"""A force learned as a last resort, where no effect explains what is missing: kept if the held-out error clearly falls."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from estimators.core.fit import Fit
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.missing_force import shared_with, significant_equation_curves
from estimators.diagnosis.model_extension import Added, add_effects, misfit
from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.diagnosis.read_law import LAWS
from estimators.misspecification.adequacy import significant
from estimators.misspecification.static_force import ForceCurve
from estimators.validation.simulation_error import Compared
from rtac_jax.effects import SplineForce
from rtac_jax.effects.spline_force import PORT_UNITS, VARIABLE_UNITS
from rtac_jax.measurement import Recording

LABEL = "+ learned force"


@dataclasses.dataclass(frozen=True)
class LearnedForce:
    """A force that was learned: a curve in one variable that makes the held-out error fall and names no physical effect.

    It is what the model's own parameters leave over: a slope in the position, say, is the spring's.

    Attributes:
        port: "cart" [N] or "arm" [N m].
        variable: of `rtac_jax.effects.spline_force.VARIABLES`.
        at: knots of the curve, SI units; the first and the last are the ends of the range that it was learned over.
        force: at the knots, as fitted; beyond the range the force keeps its last value.
        std: standard deviation of that, as of the fit; NaN where the curve was held at the estimate of the diagnosis.
        outside: experiments held out that leave the range, with the fraction of their samples that does.
        laws: formulas that would describe the curve, the likeliest on held-out data first; each is an effect in `formulas()` of the
            diagnosis' curve.
        shares: what the model estimates along the same variable, as a spring where it depends on the position; empty for none.
    """

    port: str
    variable: str
    at: Float[np.ndarray, " knot"]
    force: Float[np.ndarray, " knot"]
    std: Float[np.ndarray, " knot"]
    outside: dict[str, float]
    laws: tuple[str, ...]
    shares: str = ""

    @property
    def unit(self) -> str:
        """Return the unit of the force."""
        return PORT_UNITS[self.port]

    @property
    def variable_unit(self) -> str:
        """Return the unit of the variable."""
        return VARIABLE_UNITS[self.variable.split(",")[0]]

    @property
    def between(self) -> tuple[float, float]:
        """Return the range of the variable over which the force was learned, SI units."""
        return float(self.at[0]), float(self.at[-1])

    def as_dict(self) -> dict[str, Any]:
        """Return everything, with units, for a report's JSON."""
        return {
            "physical": False,
            "port": self.port,
            "unit": self.unit,
            "variable": self.variable,
            "variable_unit": self.variable_unit,
            "between": list(self.between),
            "beyond": "keeps its last value",
            "at": self.at.tolist(),
            "force": self.force.tolist(),
            "std": self.std.tolist(),
            "held_out_beyond": self.outside,
            "laws": list(self.laws),
        }

    def __str__(self) -> str:
        low, high = self.between
        text = (
            f"Learned force, not a physical effect: on the {self.port} against {self.variable}, up to "
            f"{np.max(np.abs(self.force)):.2g} {self.unit}, learned from {low:.3g} to {high:.3g} {self.variable_unit}; beyond "
            "that it is not known and keeps its last value."
        )
        if self.outside:
            where = ", ".join(
                f"{name} ({100 * fraction:.0f} % of the samples)" for name, fraction in self.outside.items()
            )
            text += f" Experiments held out that go beyond: {where}."
        if self.shares:
            text += f" It and {self.shares} share what they do: no deviation counts that, so take neither without the other."
        if self.laws:
            text += f" Laws that would describe it: {'; '.join(self.laws)}."
        return text


def learn_force(
    before: Fit,
    tested: Compared,
    found: Diagnosis,
    train: Recording,
    held_out: Recording,
    *,
    policy: DiagnosisPolicy = STANDARD,
    progress: bool,
) -> tuple[Added, LearnedForce] | str:
    """Return the model with a learned force that clearly serves the held-out experiments better, or why there is none.

    The curves that explain more than chance are tried, of each port the one that explains most: of predictions or, where random
    forces stand in for the physics there, of the equations of motion. What names no physics is
    kept only for a clear fall of the held-out error, or for one of the errors one sample ahead beside which it does not rise, and
    where what was fitted is not missed by more.

    Args:
        before: the model without it.
        tested: that against the held-out experiments.
        found: the diagnosis of that model, with a verdict that is unknown.
        train: the recording that is fitted.
        held_out: the recording that validates.
        policy: the thresholds by which it is kept.
        progress: show bars.
    """
    if SplineForce.id in before.model:
        return "No learned force was added: the model has one already."
    test = next((test for test in found.tests if test.test == "static force" and test.rejects), None)
    speaking = sorted(significant(found.curves, test.level) if test else [], key=lambda curve: -curve.excess)
    several: list[tuple[ForceCurve, Mapping[str, float] | None]] = [(curve, None) for curve in speaking]
    if not several and found.stands_in:
        # Predictions follow whatever is missing; the equations of motion do not.
        several = [(one.curve, one.values) for one in significant_equation_curves(before.model, train, policy)]
    if not several:
        if found.stands_in:
            return (
                "No learned force was added: beside random forces that stand in for the physics predictions do not tell whether"
                " what is missing is a function of position, velocity, angle or current, and the equations of motion along what"
                " was measured do not tell either."
            )
        return (
            "No learned force was added: what is missing is no function of position, velocity, angle or current beyond what chance"
            " makes."
        )
    label = LABEL if tested.label == "base" else f"{tested.label}, learned force"
    tried = list({curve.port: (curve, values) for curve, values in reversed(several)}.values())[::-1]
    # Near the noise any fall is enough for an effect, which physics speaks for; for a curve nothing does.
    strict = dataclasses.replace(policy, near_noise=0.0)
    for curve, values in tried:
        step = add_effects(
            before, tested, [curve.effect()], label, train, held_out, deviations={}, values=values, policy=strict,
            progress=progress,
        )  # fmt: skip
        if isinstance(step, str):
            continue
        # More of what was fitted is missed with it: what was held out is met by chance.
        if any(left > (1 + policy.fall) * before.residual_std[c] for c, left in step.fit.residual_std.items()):
            continue
        fallen = misfit(step.tested) / misfit(tested)
        if fallen <= 1 - policy.fall or (step.predicted_gain is not None and fallen <= 1):
            return step, _described(step, curve)
    where = " and ".join(f"on the {curve.port} against {curve.variable}" for curve, _ in tried)
    return f"No learned force was added: with one {where} the held-out error does not clearly fall."


def _described(step: Added, curve: ForceCurve) -> LearnedForce:
    """Return the learned force as it stands in a fitted model."""
    effect = next(effect for effect in step.fit.model.effects if isinstance(effect, SplineForce))
    shapes = np.array([[float(height) for height in shape] for shape in effect.shapes[: effect.used]])
    names = [f"{effect.id}.amount_{n}" for n in range(1, effect.used + 1)]
    amounts = np.array([float(step.fit.model[name]) for name in names])
    std = np.full(len(curve.at), np.nan)
    if set(names) <= set(step.fit.information.names):
        places = [step.fit.information.names.index(name) for name in names]
        covariance = step.fit.information.covariance[np.ix_(places, places)]
        std = np.sqrt(np.einsum("sk,st,tk->k", shapes, covariance, shapes))
    laws = tuple(law.text for law in curve.formulas(most=LAWS)) if curve.evidence is not None else ()
    outside = {name: fraction for name, (_, fraction) in step.tested.beyond.items()}
    shares = shared_with(curve.port, curve.variable, step.fit.model)
    return LearnedForce(curve.port, curve.variable, curve.at, amounts @ shapes, std, outside, laws, shares)
