"""Do different ways to estimate the same physics agree? Hausman's test, and what a disagreement means."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import f as fisher
from scipy.stats import t as student
from tqdm import tqdm

from estimators._least_squares import ClosedForm
from estimators._output_error import Fit
from estimators._replicates import Replicates, estimator_of
from rtac_jax import require_configured
from rtac_jax.effects import CATALOGUE
from rtac_jax.measurement import Recording

Vector = Float[np.ndarray, " parameter"]

# What the paper's model assumes of the parameter, and the effects that break it.
_ASSUMES = {
    "spring_stiffness": (
        "the spring is linear and all of the mass moves with the cart",
        ("cubic_spring", "quadratic_spring", "hysteretic_spring", "flexible_mode", "lvdt_nonlinearity", "end_stop"),
    ),
    "cart_viscous.coefficient": (
        "the cart's friction is viscous and dry only",
        ("cart_quadratic_drag", "cart_stribeck", "hysteretic_spring", "flexible_mode", "cubic_spring"),
    ),
    "cart_coulomb.level": (
        "the cart's dry friction is the same at all speeds",
        ("cart_stribeck", "cart_quadratic_drag", "hysteretic_spring", "gravity_tilt", "cubic_spring"),
    ),
    "eccentric_moment": (
        "the arm's angle is the integral of what the tachometer shows, and the plane is level",
        ("tacho_bias", "tacho_lag", "gravity_tilt", "channel_delay"),
    ),
    "torque_constant": (
        "the torque is proportional to the recorded current, at once and at all amplitudes",
        (
            "current_lag",
            "input_delay",
            "current_offset",
            "torque_droop",
            "dead_zone",
            "saturation",
            "tacho_lag",
            "cogging",
        ),
    ),
    "arm_viscous.positive": (
        "the arm's friction is viscous, with one coefficient for each direction",
        ("arm_coulomb", "arm_quadratic_drag", "arm_stribeck", "cogging", "tacho_bias", "current_offset"),
    ),
    "arm_viscous.negative": (
        "the arm's friction is viscous, with one coefficient for each direction",
        ("arm_coulomb", "arm_quadratic_drag", "arm_stribeck", "cogging", "tacho_bias", "current_offset"),
    ),
}


@dataclasses.dataclass(frozen=True)
class Disagreement:
    """Two ways held against each other.

    Attributes:
        labels: of the two.
        difference: first less second, less what the first's own bias would make it were the model right.
        bias: that bias, taken off.
        std: of the difference, were the model right.
        p_values: per parameter.
        p_value: jointly.
    """

    labels: tuple[str, str]
    difference: Vector
    bias: Vector
    std: Vector
    p_values: Vector
    p_value: float


@dataclasses.dataclass(frozen=True)
class Agreement:
    """Result of `agreement`.

    Attributes:
        names: of the parameters that all ways estimate.
        units: SI units.
        labels: of the ways.
        values: estimates [way parameter].
        std: their standard deviations, were the model right [way parameter].
        pairs: every two ways held against each other.
        level: at which a disagreement is called one.
        draws: replicates that the distribution of the differences was taken from.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    labels: tuple[str, ...]
    values: Float[np.ndarray, "way parameter"]
    std: Float[np.ndarray, "way parameter"]
    pairs: tuple[Disagreement, ...]
    level: float
    draws: int

    @property
    def rejected(self) -> bool:
        """Whether any two disagree by more than chance allows; the level is shared between the pairs."""
        return any(pair.p_value < self.level / len(self.pairs) for pair in self.pairs)

    @property
    def differing(self) -> tuple[str, ...]:
        """Parameters whose estimates differ, the clearest first; where they differ only jointly, the clearest one."""
        if not self.rejected:
            return ()
        smallest = np.min([pair.p_values for pair in self.pairs], axis=0)
        order = np.argsort(smallest)
        bound = self.level / (len(self.names) * len(self.pairs))
        return tuple(self.names[i] for i in order if smallest[i] < bound) or (self.names[order[0]],)

    @property
    def suspects(self) -> tuple[str, ...]:
        """Ids of effects that would make these parameters differ, for `diagnose`; the most often named first."""
        named = [effect for name in self.differing for effect in _ASSUMES.get(name, ("", ()))[1]]
        known = [effect for effect in dict.fromkeys(named) if effect in CATALOGUE]
        return tuple(sorted(known, key=lambda effect: -named.count(effect)))

    @property
    def verdict(self) -> str:
        """In words: whether they agree, which assumption fails, and what to look at next."""
        smallest = min(pair.p_value for pair in self.pairs)
        if not self.rejected:
            return (
                f"They agree: differences as large as these come about by chance (p = {smallest:.2g}). What the estimates "
                "rest on holds as far as these data can tell."
            )
        failing = list(dict.fromkeys(_ASSUMES[n][0] for n in self.differing if n in _ASSUMES))
        fails = f" Doubt first that {failing[0]}" + "".join(f", then that {f}" for f in failing[1:3]) + "."
        return (
            f"They disagree (p = {smallest:.2g}), most clearly in {', '.join(self.differing[:3])}: one model cannot be right "
            "both for each moment by itself and for the motion over a whole experiment."
            + (fails if failing else "")
            + (
                f" Ask est.diagnose, which should weigh {', '.join(self.suspects[:5])};"
                if self.suspects
                else " Ask est.diagnose;"
            )
            + " est.compare shows where the model fails."
        )

    def __str__(self) -> str:
        lines = [f"{'parameter':26s}" + "".join(f" {label:>15s} {'std':>9s}" for label in self.labels) + "  unit"]
        for i, name in enumerate(self.names):
            cells = "".join(f" {v[i]:15.6g} {s[i]:9.2g}" for v, s in zip(self.values, self.std, strict=True))
            lines.append(f"{name:26s}{cells}  {self.units[i]}")
        for pair in self.pairs:
            lines.append(f"\n{pair.labels[0]} less {pair.labels[1]}")
            lines.append(
                f"{'parameter':26s} {'difference':>12s} {'of it bias':>12s} {'std':>10s} {'sigmas':>8s} {'p':>9s}"
            )
            for i, name in enumerate(self.names):
                lines.append(
                    f"{name:26s} {pair.difference[i] + pair.bias[i]:12.3g} {pair.bias[i]:12.2g} {pair.std[i]:10.2g} "
                    f"{pair.difference[i] / pair.std[i]:8.1f} {pair.p_values[i]:9.2g}"
                )
            lines.append(f"{'all together':26s} {'':12s} {'':12s} {'':10s} {'':8s} {pair.p_value:9.2g}")
        return "\n".join([*lines, "", self.verdict])

    def plot(self) -> Any:
        """Differences in standard deviations, as a matplotlib figure."""
        from estimators.plots._agreement import plot_agreement

        return plot_agreement(self)


def agreement(
    results: Sequence[ClosedForm | Fit],
    recording: Recording,
    *,
    labels: Sequence[str] | None = None,
    level: float = 0.01,
    draws: int = 80,
    block: float = 0.25,
    seed: int = 0,
    progress: bool = True,
) -> Agreement:
    """Hold estimates of the same physics, made in different ways from the same recording, against each other.

    Hausman's idea: two estimators that are both right when the model is right differ only by chance, so a difference that
    is large beside its own standard deviation shows that the model is wrong. Neither estimator need be efficient: the
    distribution of the difference comes from replicates, in which the first fit's simulation is the truth and its residual,
    in blocks and in random order, is the noise. From each replicate every way estimates anew (a fit by one Gauss-Newton
    step), so that their common errors cancel, and the bias that a closed form has on such data is taken off.

    Args:
        results: closed forms and fits; at least one must be a fit, and a closed form should be made with `weak=True`.
        recording: the one that all were made from.
        labels: of the results.
        level: of the test.
        draws: replicates; more than three times as many as there are parameters.
        block: duration that stays together when the residual is put in another order [s]; longer than its memory.
        seed: of the replicates.
        progress: show a bar.

    Raises:
        ValueError: fewer than two results, no fit among them, no parameter in common, or too few draws.
        RuntimeError: JAX was not configured for double precision.

    Source: Hausman, Econometrica 46 (1978); joint test: Hotelling's T^2; replicates: Kuensch, Ann. Statist. 17 (1989).
    """
    require_configured()
    several = list(results)
    fits = [r for r in several if isinstance(r, Fit)]
    if len(several) < 2:
        raise ValueError("agreement holds estimates against each other; give two results or more.")
    if not fits:
        raise ValueError("agreement needs a fit, whose simulation stands for the truth; add est.output_error's result.")
    said = tuple(labels) if labels is not None else _labels(several)
    if len(said) != len(several):
        raise ValueError(f"{len(several)} results need as many labels, not {len(said)}.")
    names = _common(several)
    if not names:
        raise ValueError("the results have no estimated parameter in common.")
    if draws <= 3 * len(names):
        raise ValueError(f"draws is {draws}; {len(names)} parameters need more than {3 * len(names)}.")
    replicates = Replicates.of(fits[0], recording, block=block)
    ways = [estimator_of(result, names, replicates, recording) for result in several]
    random = np.random.default_rng(seed)
    found = np.empty((draws, len(several), len(names)))
    for number in tqdm(range(draws), desc="agreement", unit=" replicates", disable=not progress, leave=False):
        values = replicates.draw(random)
        found[number] = [way(values) for way, _ in ways]
    truth = np.array([fits[0].parameters[n].value for n in names])
    observed = np.array([value for _, value in ways])
    pairs = tuple(
        _pair((said[a], said[b]), observed[a] - observed[b], found[:, a] - found[:, b])
        for a, b in itertools.combinations(range(len(several)), 2)
    )
    spread = np.std(found - truth, axis=0, ddof=1)
    units = tuple(fits[0].parameters[n].unit for n in names)
    return Agreement(names, units, said, observed, spread, pairs, level, draws)


def _pair(labels: tuple[str, str], observed: Vector, drawn: Float[np.ndarray, "draw parameter"]) -> Disagreement:
    draws, width = drawn.shape
    bias = np.mean(drawn, axis=0)
    covariance = np.cov(drawn, rowvar=False).reshape(width, width) * (1 + 1 / draws)
    std = np.sqrt(np.diagonal(covariance))
    difference = observed - bias
    p_values = 2 * student.sf(np.abs(difference) / std, draws - 1)
    scaled = difference / std
    squared = float(scaled @ np.linalg.solve(covariance / np.outer(std, std), scaled))
    joint = float(fisher.sf(squared * (draws - width) / (width * (draws - 1)), width, draws - width))
    return Disagreement(labels, difference, bias, std, p_values, joint)


def _common(results: Sequence[ClosedForm | Fit]) -> tuple[str, ...]:
    """Names that every result estimated, in the order of the first fit."""
    sets = [set(r.estimates) if isinstance(r, ClosedForm) else set(r.information.names) for r in results]
    first = next(r for r in results if isinstance(r, Fit))
    return tuple(n for n in first.information.names if all(n in s for s in sets))


def _labels(results: Sequence[ClosedForm | Fit]) -> tuple[str, ...]:
    said = ["closed form" if isinstance(r, ClosedForm) else "output error" for r in results]
    return tuple(s if said.count(s) == 1 else f"{s} {said[:i].count(s) + 1}" for i, s in enumerate(said))
