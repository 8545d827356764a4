"""The difference between experiments that a fit does not follow together: one parameter, or one experiment alone."""

import contextlib
import dataclasses
from collections.abc import Mapping

import numpy as np

from estimators.core.data import moving
from estimators.core.fit import Fit
from estimators.core.results import FAILURES, DivergedError, NotIdentifiableError
from estimators.inference.constancy import BEYOND_ONE_STEP, constancy
from estimators.inference.varying_parameters import ENOUGH, NEXT_TO_ALL
from estimators.linear.homogeneity_test import Equality, trend_of, varying
from estimators.linear.outlier import FOLLOWED, Outlier
from estimators.output_error.fit import output_error
from estimators.validation.simulation_error import compare
from rtac_jax import RTAC
from rtac_jax.measurement import Recording

WORTH_ASKING = 3.0  # residual over noise, as far as that is known, from which it is asked whether experiments differ
_OWN_PARAMETERS = 4  # those that scatter most, each of which is tried with a value for each experiment
_STEPS = 30  # of these fits: the one that follows converges in a few
_MOST = 0.5  # of the differences, which an experiment must take with it to be asked alone
# What fits of single experiments may leave, over what the common fit does, for a parameter to be asked: 0.09 where a spring had
# lost 3 % and the common fit was too far off for them to come to their ends. Named is only what then follows all to the noise.
_NEXT_TO_NOTHING = 0.1
_FITS_OF_OTHERS = 2  # experiments that are asked alone at most


def differing(
    fit: Fit, recording: Recording, *, least: float = WORTH_ASKING, coloured: Mapping[str, float] | None = None
) -> Equality | None:
    """Return what differs between experiments, where one parameter or one experiment alone explains it; None elsewhere.

    An experiment alone does where a fit of all others follows these to the noise, leaves next to no difference between them, and
    does not follow this one. Asked are those that take half of the differences with them: where one is far off, the common fit is
    too far from the others for its linearisation to tell more. Nothing is asked of pieces of long experiments, which have no values
    of their own.

    Args:
        fit: of output error.
        recording: that was fitted.
        least: residual over noise of the fit, from which it is asked.
        coloured: rms of coloured noise by channel, where it is larger than what fast changes show of the noise.
    """
    noise = {channel: max(size, (coloured or {}).get(channel, 0.0)) for channel, size in fit.noise.items()}
    if fit.lost or fit.farthest <= least or fit.in_pieces:
        return None
    try:
        found = constancy(fit, recording)
    except (ValueError, ArithmeticError):  # too few experiments, or one that shows nothing by itself
        return None
    over, usual = (
        {c: x * fit.noise[c] / noise[c] for c, x in one.items()} for one in (found.over_noise, found.median_over_noise)
    )
    found = dataclasses.replace(found, over_noise=over, median_over_noise=usual)
    apart = [one for one in _suspects(fit, recording, found) if one.decisive]
    if len(apart) == 1:
        found = dataclasses.replace(found, outlying=apart[0])
    # One parameter explains no more than all of them do, by one step and in fits of single experiments, and the fits that ask are
    # dear.
    # A fit by predictions, or one with something held, has no count of its own.
    values = [s.values for e in moving(recording) for c, s in e.outputs.items() if c in fit.noise]
    large = found.chi_square > BEYOND_ONE_STEP * sum(int(np.sum(np.isfinite(one))) for one in values)
    followed = all(
        ratio <= max(FOLLOWED, _NEXT_TO_NOTHING * fit.residual_std[c] / noise[c]) for c, ratio in usual.items()
    )
    if not found.differences and not found.equal and large and followed:
        found = _with_own_parameter(fit, recording, found, noise)
    return found if found.differences else None


def _with_own_parameter(fit: Fit, recording: Recording, found: Equality, noise: Mapping[str, float]) -> Equality:
    """Return the test with the one parameter that, free in each experiment, lets a fit follow all of them to the noise.

    Far from the data one step from the common fit does not tell it, and an experiment by itself, as a decay, need not show all
    parameters. As it was where none does, or more than one.

    Args:
        fit: of all, with one set of parameters.
        recording: that was fitted.
        found: says by how much each parameter scatters.
        noise: rms by channel.
    """
    if fit.model.per_experiment:
        return found
    scatter = np.nansum((found.values - found.common) ** 2 / found.std**2, axis=0)
    following: dict[int, tuple[Fit, dict[str, float]]] = {}
    for place in np.argsort(-scatter)[:_OWN_PARAMETERS]:
        own = _begun(fit, found, int(place))
        with contextlib.suppress(ArithmeticError, *FAILURES):
            one = output_error(own, recording, from_model=True, steps=_STEPS, progress=False)
            over = {channel: size / noise[channel] for channel, size in one.residual_std.items()}
            if max(over.values()) <= FOLLOWED:
                following[int(place)] = one, over
    if len(following) != 1:
        return found
    ((place, (one, over_noise)),) = following.items()
    name = found.names[place]
    each = np.asarray(one.model[name])
    spread = found.std[:, place] * one.farthest / fit.farthest  # of residuals as large as those that are left now
    std = np.where(np.isfinite(spread), spread, np.nanmax(spread))
    told = varying(found.covariates)
    trends = list(found.trends)
    trends[place] = tuple(trend_of(covariate, x, each, np.diag(std**-2.0)) for covariate, x in told.items())
    values, deviations, common = found.values.copy(), found.std.copy(), found.common.copy()
    values[:, place], deviations[:, place], common[place] = each, std, float(np.mean(each))
    return dataclasses.replace(
        found, values=values, std=deviations, common=common, trends=tuple(trends), varying=(name,), explained=1.0,
        rival=0.0, suffices=True, over_noise=over_noise,
    )  # fmt: skip


def _begun(fit: Fit, found: Equality, place: int) -> RTAC:
    """Return the model with a parameter of each experiment, at the values that each has by itself with the others in common.

    All others are at the medians of theirs: the common fit is far from all experiments where a parameter drifts, and a long
    simulation has many minima. Where no experiment was fitted by itself, at the common fit.
    """
    if not found.median_over_noise:
        return fit.model.each_experiment(found.names[place])
    usual = found.common.copy()
    shown = np.isfinite(found.values).any(axis=0)
    usual[shown] = np.nanmedian(found.values[:, shown], axis=0)
    model = fit.model.with_values(dict(zip(found.names, map(float, usual), strict=True)))
    name, each = found.names[place], found.values[:, place]
    return model.each_experiment(name).with_values({name: np.where(np.isfinite(each), each, usual[place])})


def may_show_alone(recording: Recording, one: Outlier) -> bool:
    """Return whether an experiment moves so much farther than the others that it may alone show what the model lacks.

    That is, whether what grows as the cube of the motion, as a spring that hardens, and leaves so much of it, would be within the
    noise of all others.

    Args:
        recording: with all of them.
        one: the experiment, with what a fit of the others leaves of it.
    """
    alone = next(e for e in recording if e.name == one.name)
    others = [e for e in moving(recording) if e.name != one.name]
    farther = 0.0
    for channel, signal in alone.outputs.items():
        reached = max(
            (float(np.nanstd(e.outputs[channel].values)) for e in others if channel in e.outputs), default=0.0
        )
        if reached > 0:
            farther = max(farther, float(np.nanstd(signal.values)) / reached)
    return farther**3 >= one.left


def _suspects(fit: Fit, recording: Recording, found: Equality) -> list[Outlier]:
    """Return the experiments that take half of the differences with them, each with a fit of all others."""
    if fit.model.per_experiment or found.equal or len(found.conditions) < ENOUGH:
        return []
    several = [
        Outlier(name, *left)
        for name, left in zip(found.conditions, found.left_without, strict=True)
        if left[0] <= _MOST * found.chi_square
    ]
    several = sorted(several, key=lambda one: one.chi_square)[:_FITS_OF_OTHERS]
    little = (1 - NEXT_TO_ALL) * found.chi_square
    return [_with_fit_of_others(fit, recording, one, little) for one in several]


def _with_fit_of_others(fit: Fit, recording: Recording, one: Outlier, little: float) -> Outlier:
    """Return an experiment with a fit of all others, and with what that leaves; as it is where the others differ by more.

    Args:
        fit: of all.
        recording: that was fitted.
        one: the experiment.
        little: chi-square of differences between the others that are of no consequence.
    """
    others, alone = (
        recording.select([e.name for e in recording if e.kind == "rest" or (e.name == one.name) == its])
        for its in (False, True)
    )
    for from_model in (True, False):  # what one experiment led astray may be no place to begin
        try:
            without = output_error(fit.model, others, from_model=from_model, progress=False)
            between = constancy(without, others)
            worst = compare(without, alone).models[0].worst(1)[0]
        except (ValueError, ArithmeticError, NotIdentifiableError, DivergedError):
            continue
        if not between.equal and between.chi_square > little:
            continue
        one = dataclasses.replace(
            one,
            chi_square=between.chi_square,
            freedom=between.freedom,
            fit=without,
            over_noise=without.farthest,
            left=worst.rms / worst.noise,
            channel=worst.channel,
        )
        if one.decisive:
            break
    return one
