"""Test of homogeneity: whether the parameters of a linear model are the same in all conditions, and what drifts."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.stats
from jaxtyping import Float

from estimators.core.drawing import draw
from estimators.linear.model import LinearModel
from estimators.linear.outlier import FOLLOWED, Outlier
from estimators.linear.step_change import step_in_words, values_in_words
from rtac_jax.renamed import renamed

_DETERMINED = 0.5  # standard deviation over value
_SINGULAR = 1e-9  # of correlations
_NO_RIVAL = 0.9  # of what one quantity explains, below which another does not explain as much
Covariates = Mapping[str, Mapping[str, float]]
"""Further covariates: by name, and then by condition or experiment."""

_WORDS = {
    "amplitude": "the amplitude (output rms)",
    "input": "the input's amplitude (rms)",
    "angle": "the arm's angle (cos² θ₀)",
    "mean_angle": "the mean arm angle (θ₀ [rad])",
    "time": "the order of time",
}


_MOTION = (
    "amplitude",
    "input",
    "angle",
    "mean_angle",
)  # covariates that are of the motion, and not of the time or the weather


@dataclass(frozen=True)
class Trend:
    """The weighted regression of one quantity on one covariate.

    Attributes:
        covariate: "amplitude", the rms of the output; "input", that of the input; "angle", cos^2 of the mean arm angle, and
            "mean_angle", the angle itself; "time", the order of the conditions; or one that was given.
        slope, slope_std: change of the quantity over the range of the covariate. The deviation counts what scatters
            beyond the estimates' own uncertainty.
        fraction: fraction of the scatter's chi-square that the regression removes [1].
        p_value: of no slope.
    """

    covariate: str
    slope: float
    slope_std: float
    fraction: float
    p_value: float

    share = renamed("share", "fraction")


@dataclass(frozen=True, eq=False)
class Equality:
    """The result of `LinearModels.equality`.

    Attributes:
        names, units: of the quantities.
        conditions: names of the conditions.
        values, std: [condition, quantity].
        common, common_std: the weighted mean over conditions.
        chi_square, freedom, p_value: of all quantities being equal, jointly.
        p_values: of each one alone.
        trends: of each quantity on each covariate that is known.
        covariates: their values by name, one for each condition.
        left_out: conditions that determine a natural frequency or damping ratio worse than to half its size, where standard
            deviations mean little.
        level: at which equality is called broken.
        varying: of a nonlinear fit the fewest quantities, three at most, that explain that conditions differ, the one that
            explains most by itself first.
        explained: fraction of the differences that these explain together [1].
        rival: fraction that the best other set of as many explains [1].
        suffices: whether what these leave is chance, or of no consequence.
        over_noise: of a nonlinear fit what is left over the noise at most, by channel, where each condition was fitted by itself;
            empty where none was. Values, their deviations and `varying` then allow each quantity a thousandth of its size.
        median_over_noise: the median of that over the conditions.
        left_without: of a nonlinear fit chi-square and freedom of the differences that are left without each condition.
        confirmed: of a nonlinear fit whether one of all conditions together, with `varying` free in each, follows all to the noise.
        outlying: of a nonlinear fit the one experiment of four or more without which next to nothing of the differences is left,
            and no more than chance makes, or which a fit of all others that follows them does not follow; None where there is none,
            or more than one.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    conditions: tuple[str, ...]
    values: Float[np.ndarray, "condition quantity"]
    std: Float[np.ndarray, "condition quantity"]
    common: Float[np.ndarray, " quantity"]
    common_std: Float[np.ndarray, " quantity"]
    chi_square: float
    freedom: int
    p_value: float
    p_values: Float[np.ndarray, " quantity"]
    trends: tuple[tuple[Trend, ...], ...]
    covariates: dict[str, Float[np.ndarray, " condition"]]
    left_out: tuple[str, ...]
    level: float
    varying: tuple[str, ...] = ()
    explained: float = 0.0
    rival: float = 0.0
    suffices: bool = True
    over_noise: Mapping[str, float] = field(default_factory=dict)
    median_over_noise: Mapping[str, float] = field(default_factory=dict)
    left_without: tuple[tuple[float, int], ...] = ()
    confirmed: bool = False
    outlying: Outlier | None = None

    @property
    def _with_motion(self) -> str:
        """Return the covariate of the motion with which one of the few quantities goes; empty where none does."""
        trends = [self.best_trend(name) for name in self.varying]
        return next((trend.covariate for trend in trends if trend is not None and trend.covariate in _MOTION), "")

    @property
    def equal(self) -> bool:
        """Return whether equality of all quantities stands."""
        return self.p_value >= self.level

    @property
    def drifting(self) -> tuple[str, ...]:
        """Quantities that differ between conditions, the one with the largest chi-square first."""
        if self.equal:
            return ()
        if self.varying:
            return self.varying
        bound = self.level / len(self.names)
        order = np.argsort(-np.nansum((self.values - self.common) ** 2 / self.std**2, axis=0))
        return tuple(self.names[i] for i in order if self.p_values[i] < bound) or (self.names[order[0]],)

    @property
    def decisive(self) -> bool:
        """Return whether the model follows each condition by itself, one set for all does not, and few quantities explain that.

        Several that differ at once are what a missing effect looks like, if no fit with these free in each condition follows all;
        and so is one, or are few, beside which others explain as much.
        """
        left = max(self.over_noise.values(), default=math.inf)
        few = len(self.varying) == 1 or self.confirmed
        alone = few and self.suffices and self.rival < _NO_RIVAL * self.explained
        return not self.equal and alone and left <= FOLLOWED

    @property
    def is_of_the_rig(self) -> bool:
        """Return whether few quantities explain the differences, and none goes with the motion, as what is missing would."""
        return self.decisive and not self._with_motion

    @property
    def differences(self) -> str:
        """Return, where few quantities or one experiment alone explain it, what differs, and what to do about it; else nothing."""
        alone = self.outlying.words if self.outlying is not None and self.outlying.decisive else ""
        if not self.decisive:
            return alone
        if self._with_motion:
            advice = (
                f"What goes with {covariate_words(self._with_motion)} is an effect that the model lacks, as a spring that hardens, "
                "sooner than a drift: ask est.diagnose."
            )
        elif alone:
            advice = alone
        else:
            names = ", ".join(f'"{name}"' for name in self.varying)
            advice = (
                "Where est.diagnose names no effect that explains it better, fit a value for each experiment "
                f"(model.each_experiment({names}))."
            )
        return (
            f"Experiments differ: with parameters of its own each is followed to {max(self.over_noise.values()):.2f} times the "
            f"noise or less, and with one set for all they are not. {' '.join(self._differing())} {advice}"
        )

    def best_trend(self, name: str) -> Trend | None:
        """Return the covariate that explains most of this quantity's scatter, where one does beyond chance."""
        each = self.trends[self.names.index(name)]
        if not each:
            return None
        found = min(each, key=lambda trend: trend.p_value)
        return found if found.p_value < self.level / len(each) else None

    @property
    def verdict(self) -> str:
        """Return the verdict in words: equal or not, which quantity drifts, and with what; and how many were left out."""
        without = [f"{len(self.left_out)} of {len(self.conditions) + len(self.left_out)} were left out."] * bool(
            self.left_out
        )
        if self.equal:
            same = (
                f"The {len(self.conditions)} conditions have one set of parameters, as far as these data tell "
                f"(p = {self.p_value:.2g})."
            )
            return " ".join([same, *without])
        return " ".join(
            [
                f"The conditions differ (chi-square {self.chi_square:.0f} on {self.freedom}, p = {self.p_value:.2g}).",
                *self._differing(),
                *self._left(),
                *([self.outlying.words] if self.outlying is not None else []),
                *without,
            ]
        )

    def _differing(self) -> list[str]:
        """Say of each quantity that differs with what it does."""
        said = []
        for name in self.drifting[:3]:
            place = self.names.index(name)
            trend = self.best_trend(name)
            unit = "" if self.units[place] == "1" else f" {self.units[place]}"
            each, std = self.values[:, place], self.std[:, place]
            step = step_in_words(self.conditions, each, std) if name in self.varying else ""
            if step and (trend is None or trend.covariate not in _MOTION):
                said.append(f"{name[0].upper()}{name[1:]} {step}.")
            elif trend is None:
                how = values_in_words(self.conditions, each, std) if name in self.varying else ""
                said.append(f"{name[0].upper()}{name[1:]} {how or 'scatters, with nothing that was looked at'}.")
            else:
                said.append(
                    f"{name[0].upper()}{name[1:]} drifts with {covariate_words(trend.covariate)}: {trend.slope:+.3g} ± "
                    f"{trend.slope_std:.1g}{unit} over its range, {100 * trend.fraction:.0f} % of the scatter."
                )
        if self.varying:
            alone = "That alone explains" if len(self.varying) == 1 else "Together they explain"
            rest = "" if self.suffices else ", and the rest is no chance"
            said.append(f"{alone} {100 * self.explained:.0f} % of the difference{rest}.")
        return said

    def _left(self) -> list[str]:
        """Say where even fits of single conditions leave too much, so that what differs is not told."""
        worst = max(self.over_noise, key=lambda c: self.over_noise[c], default="")
        if not worst or self.over_noise[worst] <= FOLLOWED:
            return []
        return [
            f"But fitted by itself, too, a condition is left at {self.over_noise[worst]:.3g} times the noise ({worst}): what the "
            "model lacks, or what changes within a condition, shows as a difference between them, and these names are no finding."
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return which quantities differ, if that is decisive, with their values, and which condition alone differs."""
        alone, one = self.decisive, self.outlying
        places = [self.names.index(name) for name in self.varying if alone]
        return {
            "explained": self.explained if alone else 0.0,
            "outlying": one.name if one is not None and one.decisive else None,
            "experiments": list(self.conditions),
            "parameters": {
                self.names[i]: {"values": self.values[:, i].tolist(), "std": self.std[:, i].tolist()} for i in places
            },
        }

    def __str__(self) -> str:
        rows = [
            f"{'quantity':24s} {'mean':>12s} {'its std':>9s} {'scatter/std':>11s} {'p':>9s}  drifts with",
        ]
        for i, name in enumerate(self.names):
            sigma = float(np.sqrt(np.nanmean((self.values[:, i] - self.common[i]) ** 2 / self.std[:, i] ** 2)))
            trend = self.best_trend(name) if name in self.drifting else None
            rows.append(
                f"{name:24s} {self.common[i]:12.5g} {self.common_std[i]:9.2g} {sigma:11.2f} {self.p_values[i]:9.2g}  "
                f"{trend.covariate if trend else ''}"
            )
        if self.left_out:
            rows.append(f"left out, as they hardly determine a mode: {', '.join(self.left_out)}")
        return "\n".join([*rows, self.verdict])

    def plot(self) -> Any:
        """Draw each quantity over the conditions, or over the covariate with which it drifts."""
        return draw(self)


def covariate_words(name: str) -> str:
    """Return what a covariate is, in words."""
    return _WORDS.get(name, name)


def given_covariates(given: Covariates | None, names: Sequence[str]) -> dict[str, Float[np.ndarray, " condition"]]:
    """Return covariates that a user gave, in the order of these conditions.

    Raises:
        ValueError: a condition has no value, or one that is not finite, or too many were given.
    """
    found = {}
    for covariate, values in (given or {}).items():
        missing = [name for name in names if name not in values]
        if missing:
            raise ValueError(f"covariates: {covariate} has no value for {missing[0]}; give one for each condition.")
        found[covariate] = np.array([float(values[name]) for name in names])
        if not np.all(np.isfinite(found[covariate])):
            wrong = names[int(np.argmin(np.isfinite(found[covariate])))]
            raise ValueError(f"covariates: {covariate} of {wrong} is not finite; give a number.")
    return found


def varying(covariates: Mapping[str, Float[np.ndarray, " condition"]]) -> dict[str, Float[np.ndarray, " condition"]]:
    """Return the covariates that differ between conditions."""
    return {name: x for name, x in covariates.items() if np.ptp(x) > 1e-9 * np.max(np.abs(x))}


def equality_of(models: Sequence[LinearModel], level: float, given: Covariates | None = None) -> Equality:
    """Test whether the models of all conditions have the same parameters, at this level of significance.

    Args:
        models: of the conditions, in the order of time.
        level: of significance.
        given: further covariates, by name and condition.

    Raises:
        ValueError: fewer than three conditions determine their modes, or a covariate lacks a value.
    """
    everyone = models
    models = [m for m in everyone if not m.undetermined and _known(m)]
    if len(models) < 3:
        free = [m for m in everyone if m.undetermined]
        if len(everyone) - len(free) < 3 <= len(everyone):
            raise ValueError(
                f"equality: in {len(free)} of {len(everyone)} conditions the data leave unknowns free, of the noise model too, and "
                f"deviations are too small there to be compared; {free[0].fewer} would do, or structure='output_error'."
            )
        raise ValueError(
            f"equality: {len(models)} of {len(everyone)} condition(s) determine their modes, too few to tell a drift; give at "
            "least three, or fit fewer modes."
        )
    values = np.stack([m.values for m in models])
    std = np.stack([m.std for m in models])
    scaled = [m.covariance / np.outer(s, s) for m, s in zip(models, std, strict=True)]
    inverse = np.stack(
        [np.linalg.pinv(c, rcond=_SINGULAR, hermitian=True) / np.outer(s, s) for c, s in zip(scaled, std, strict=True)]
    )
    total, size = np.sum(inverse, axis=0), 1 / np.min(std, axis=0)
    common = np.linalg.solve(total / np.outer(size, size), np.einsum("cpq,cq->p", inverse, values) / size) / size
    away = values - common
    chi_square = float(np.einsum("cp,cpq,cq->", away, inverse, away))
    freedom = (len(models) - 1) * values.shape[1]
    weight = 1 / std**2
    alone = np.sum(weight * values, axis=0) / np.sum(weight, axis=0)
    each = np.sum(weight * (values - alone) ** 2, axis=0)
    covariates = {"amplitude": np.array([float(np.sqrt(np.nanmean(m.output**2))) for m in models])}
    covariates["input"] = np.array([m.input_rms for m in models])
    angles = [m.arm_angle for m in models]
    if all(angle is not None for angle in angles):
        covariates["angle"] = np.cos(np.array(angles, dtype=float)) ** 2
        covariates["mean_angle"] = np.array(angles, dtype=float)
    covariates["time"] = np.array([1 + place for place, m in enumerate(everyone) if m in models], dtype=float)
    covariates = varying(covariates | given_covariates(given, [m.name for m in models]))
    trends = tuple(
        tuple(trend_of(name, x, values[:, i], np.diag(weight[:, i])) for name, x in covariates.items())
        for i in range(values.shape[1])
    )
    return Equality(
        names=models[0].names, units=models[0].units, conditions=tuple(m.name for m in models), values=values, std=std,
        common=alone, common_std=1 / np.sqrt(np.sum(weight, axis=0)), chi_square=chi_square, freedom=freedom,
        p_value=float(scipy.stats.chi2.sf(chi_square, freedom)),
        p_values=scipy.stats.chi2.sf(each, len(models) - 1), trends=trends, covariates=covariates,
        left_out=tuple(m.name for m in everyone if m not in models), level=level,
    )  # fmt: skip


def _known(model: LinearModel) -> bool:
    count = 2 * model.structure.modes
    return bool(np.all(model.std[:count] < _DETERMINED * model.values[:count]))


def trend_of(
    name: str,
    covariate: Float[np.ndarray, " condition"],
    values: Float[np.ndarray, " condition"],
    precision: Float[np.ndarray, "condition condition"],
) -> Trend:
    """Regress the values of a quantity on a covariate, weighted by the inverse of their covariance."""
    x = (covariate - np.min(covariate)) / np.ptp(covariate)
    columns = np.stack([np.ones_like(x), x], axis=1)
    information = columns.T @ precision @ columns
    found = np.linalg.solve(information, columns.T @ precision @ values)
    away, flat = values - columns @ found, values - np.sum(precision @ values) / np.sum(precision)
    left, before = float(away @ precision @ away), float(flat @ precision @ flat)
    freedom = len(x) - 2
    excess = max(left / freedom, 1.0)
    slope_std = float(np.sqrt(excess * np.linalg.inv(information)[1, 1]))
    p_value = float(2 * scipy.stats.t.sf(abs(found[1]) / slope_std, freedom))
    return Trend(name, float(found[1]), slope_std, 1 - left / before if before > 0 else 0.0, p_value)
