"""Test of constancy: whether the parameters of a nonlinear fit are the same in every experiment, and what they drift with."""

from collections.abc import Sequence

import numpy as np
import scipy.stats
from jaxtyping import Float

from estimators.core.correlation import require_level
from estimators.core.data import moving
from estimators.core.fit import Fit
from estimators.core.linearisation import at_fit
from estimators.inference.separate_fits import about_common, about_own
from estimators.inference.varying_parameters import SHOWN, explained, is_followed, left_without, outlying, selected
from estimators.linear.homogeneity_test import Covariates, Equality, given_covariates, trend_of, varying
from estimators.linear.outlier import Outlier
from rtac_jax import require_configured
from rtac_jax.arguments import checked_arguments
from rtac_jax.measurement import Experiment, Recording

# Fraction of the squared residual that differences explain, from which on they are too large for one step.
BEYOND_ONE_STEP = 0.5
LEAST = 3  # experiments that a trend and what scatters beside it need


@checked_arguments
def constancy(fit: Fit, recording: Recording, *, covariates: Covariates | None = None, level: float = 0.01) -> Equality:
    """Test whether every experiment has the parameters of a fit; if not, name what drifts, and with which covariate.

    One parameter after the other is set free in every experiment, while the others, common to all, follow, by one
    Gauss-Newton step from the fit: the estimates of experiments that fit alone would leave undetermined are told so, too. Where
    the residual is to a good part such differences, which may lead simulations too far for one step, every experiment is fitted by
    itself. The fewest parameters are named that explain the differences if they are free in each experiment, and the one
    experiment, if there is one, without which all others have one set of parameters. A drift is looked
    for with the rms of input and output, the mean arm angle where it was measured, the place of the experiment in the recording
    and whatever is given. The residual is taken as white with the rms that the fit left, as the fit's own standard deviations take
    it, or all fits of single experiments together. Constants that were measured with a standard deviation are held: one experiment
    alone says nothing of them.

    Args:
        fit: of output error.
        recording: that was fitted.
        covariates: further ones, by name and experiment, for instance {"temperature": {"free_1": 21.5, ...}}, or a time.
        level: of significance.

    Returns:
        Estimates by experiment, NaN where it does not show the parameter; p-values, trends and a verdict.

    Raises:
        ValueError: fewer than three experiments, the recording is another, or a covariate lacks a value.
        RuntimeError: JAX was not configured for double precision.

    Source: a test of parameter constancy by scores as in Nyblom, J. Am. Stat. Assoc. 84 (1989), with experiments for times.
    """
    require_level(level)
    require_configured()
    problem = at_fit(fit, recording)
    experiments = problem.experiments
    if len(experiments) < LEAST:
        raise ValueError(f"constancy: {len(experiments)} experiment(s) show no drift; give at least {LEAST}.")
    names = tuple(name for name in problem.names if name not in fit.model.priors)
    around = about_common(problem, names)
    chi_square, freedom = explained(around.information, around.slope, range(len(names)))
    p_value = float(scipy.stats.chi2.sf(chi_square, freedom))
    if p_value < level and chi_square > BEYOND_ONE_STEP * float(np.sum(np.asarray(problem.arguments.data.present))):
        around = about_own(fit, problem, recording, names) or around
    information, slope = around.information, around.slope
    estimates = np.array([float(np.asarray(fit.model[name])) for name in names])
    every = _covariates(experiments, recording, covariates)
    shape = (len(experiments), len(names))
    values, std = np.full(shape, np.nan), np.full(shape, np.nan)
    common, common_std, p_values = estimates.copy(), np.zeros(len(names)), np.ones(len(names))
    trends = []
    for i in range(len(names)):
        shown = information[:, i, i] > SHOWN * np.max(information[:, i, i])
        if np.sum(shown) < LEAST:
            trends.append(())
            common_std[i] = fit.parameters[names[i]].std
            continue
        away, precision = _by_experiment(information, slope, i, shown)
        each = estimates[i] * np.exp(away / estimates[i]) if around.logarithmic[i] else estimates[i] + away
        spread = np.diagonal(np.linalg.inv(precision))  # negative by rounding where another parameter does the same
        values[shown, i], std[shown, i] = each, np.sqrt(np.where(spread > 0, spread, np.nan))
        weight = np.sum(precision, axis=0)
        total = float(np.sum(weight))
        common[i], common_std[i] = float(weight @ each) / total, total**-0.5 if total > 0 else np.nan
        beside = each - common[i]
        p_values[i] = scipy.stats.chi2.sf(beside @ precision @ beside, int(np.sum(shown)) - 1)
        told = varying({name: x[shown] for name, x in every.items()})
        trends.append(tuple(trend_of(name, x, each, precision) for name, x in told.items()))
    exact = around.exact
    chosen = (
        selected(information, slope, level)
        if exact is None
        else selected(information, slope, level, followed=lambda free: is_followed(*exact, free))
    )
    one = outlying(information, slope, level)
    return Equality(
        names=names, units=tuple(fit.model.parameters[name].unit for name in names),
        conditions=tuple(e.name for e in experiments), values=values, std=std, common=common, common_std=common_std,
        chi_square=chi_square, freedom=freedom, p_value=p_value, p_values=p_values,
        trends=tuple(trends), covariates=every,
        left_out=tuple(e.name for e, row in zip(experiments, values, strict=True) if np.all(np.isnan(row))), level=level,
        varying=tuple(names[i] for i in chosen.places), explained=chosen.fraction, rival=chosen.rival,
        suffices=chosen.suffices, over_noise=around.over_noise, median_over_noise=around.median_over_noise,
        outlying=None if one is None else Outlier(experiments[one.place].name, *one[1:]),
        left_without=left_without(information, slope),
    )  # fmt: skip


def _by_experiment(
    information: Float[np.ndarray, "experiment parameter parameter"],
    slope: Float[np.ndarray, "experiment parameter"],
    place: int,
    shown: np.ndarray,
) -> tuple[Float[np.ndarray, " there"], Float[np.ndarray, "there there"]]:
    """Return steps of one parameter in each experiment that shows it and their precision, with the other parameters eliminated."""
    others = np.arange(information.shape[1]) != place
    total = np.sum(information, axis=0)
    known = np.diagonal(total)
    size = np.where(
        known > 0, 1 / np.sqrt(np.where(known > 0, known, 1.0)), 0.0
    )  # of what nothing shows nothing is eliminated
    between = information[shown][:, place, others] * size[others]
    inverse = np.linalg.pinv(total[np.ix_(others, others)] * np.outer(size[others], size[others]), hermitian=True)
    precision = np.diag(information[shown, place, place]) - between @ inverse @ between.T
    wanted = slope[shown, place] - between @ inverse @ (np.sum(slope, axis=0)[others] * size[others])
    return -np.linalg.solve(precision, wanted), precision


def _covariates(
    experiments: Sequence[Experiment], recording: Recording, given: Covariates | None
) -> dict[str, Float[np.ndarray, " experiment"]]:
    def rms(values: np.ndarray) -> float:
        return float(np.sqrt(np.nanmean(values**2)))

    channel = next(
        (c for c in ("cart_position", "arm_angle", "arm_velocity") if all(c in e.outputs for e in experiments)), ""
    )
    found = {}
    if channel:
        found["amplitude"] = np.array([rms(e.outputs[channel].values) for e in experiments])
    found["input"] = np.array([rms(e.inputs["current"].values) if "current" in e.inputs else 0.0 for e in experiments])
    if all("arm_angle" in e.outputs for e in experiments):
        angle = np.array([float(np.nanmean(e.outputs["arm_angle"].values)) for e in experiments])
        found |= {"mean_angle": angle, "angle": np.cos(angle) ** 2}
    order = {e.name: float(1 + place) for place, e in enumerate(moving(recording))}
    found["time"] = np.array([order.get(e.name, float(1 + n)) for n, e in enumerate(experiments)])
    return varying(found | given_covariates(given, [e.name for e in experiments]))
