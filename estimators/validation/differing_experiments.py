"""The difference between experiments that a fit does not follow together: a few parameters, or one experiment alone."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from estimators.core.data import moving
from estimators.core.fit import Fit
from estimators.core.results import FAILURES, DivergedError, NotIdentifiableError
from estimators.inference.constancy import BEYOND_ONE_STEP, LEAST, constancy
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
    """Return what differs between experiments, where few parameters or one experiment alone explain it; None elsewhere.

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
    if not found.differences and not found.equal and large and followed and not fit.model.per_experiment:
        if len(found.varying) > 1 and found.suffices:
            found = _with_own_set(fit, recording, found, noise)
        if not found.confirmed:
            found = _with_own_parameter(fit, recording, found, noise)
    return found if found.differences else None


def _with_own_set(fit: Fit, recording: Recording, found: Equality, noise: Mapping[str, float]) -> Equality:
    """Return the test, confirmed where one fit with the named parameters free in each experiment follows all to the noise.

    A warm motor changes the friction of both directions, and what shows that is not one parameter. As it was where it does not.

    Args:
        fit: of all, with one set of parameters.
        recording: that was fitted.
        found: names several parameters.
        noise: rms by channel.
    """
    places = [found.names.index(name) for name in found.varying]
    one = _followed(fit, recording, found, places, noise)
    return found if one is None else dataclasses.replace(_with_values(found, places, *one), confirmed=True)


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
    scatter = np.nansum((found.values - found.common) ** 2 / found.std**2, axis=0)
    following: dict[int, tuple[Fit, dict[str, float]]] = {}
    for place in np.argsort(-scatter)[:_OWN_PARAMETERS]:
        if (one := _followed(fit, recording, found, [int(place)], noise)) is not None:
            following[int(place)] = one
    if len(following) != 1:
        return found
    ((place, one),) = following.items()
    alone = dataclasses.replace(found, varying=(found.names[place],), explained=1.0, rival=0.0, suffices=True)
    return _with_values(alone, [place], *one)


def _followed(
    fit: Fit, recording: Recording, found: Equality, places: Sequence[int], noise: Mapping[str, float]
) -> tuple[Fit, dict[str, float]] | None:
    """Return a fit with these parameters free in each experiment, and what it leaves over the noise, where that is the noise."""
    own = _begun(fit, found, places)
    with contextlib.suppress(ArithmeticError, *FAILURES):
        one = output_error(own, recording, from_model=True, steps=_STEPS, progress=False)
        over = {channel: size / noise[channel] for channel, size in one.residual_std.items()}
        if max(over.values()) <= FOLLOWED:
            return one, over
    return None


def _with_values(found: Equality, places: Sequence[int], one: Fit, over_noise: Mapping[str, float]) -> Equality:
    """Return the test with the values that a fit of all experiments together has in each.

    Args:
        found: the test.
        places: of the parameters that are free in each experiment.
        one: the fit with these.
        over_noise: what it leaves, by channel.
    """
    trends = list(found.trends)
    values, deviations, common = found.values.copy(), found.std.copy(), found.common.copy()
    for place in places:
        each, std = np.asarray(one.model[found.names[place]]), one.each_std[found.names[place]]
        shown = np.isfinite(std)
        weights = std[shown] ** -2.0
        told = varying({name: x[shown] for name, x in found.covariates.items()}) if np.sum(shown) >= LEAST else {}
        trends[place] = tuple(trend_of(name, x, each[shown], np.diag(weights)) for name, x in told.items())
        values[:, place], deviations[:, place] = np.where(shown, each, np.nan), std
        common[place] = np.average(each[shown], weights=weights) if len(weights) else np.nan
    return dataclasses.replace(
        found, values=values, std=deviations, common=common, trends=tuple(trends), over_noise=over_noise
    )


def _begun(fit: Fit, found: Equality, places: Sequence[int]) -> RTAC:
    """Return the model with parameters of each experiment, at the values that each has by itself with the others in common.

    All others are at the medians of theirs: the common fit is far from all experiments where a parameter drifts, and a long
    simulation has many minima. Where no experiment was fitted by itself, at the common fit.
    """
    names = [found.names[place] for place in places]
    if not found.median_over_noise:
        return fit.model.each_experiment(*names)
    usual = found.common.copy()
    shown = np.isfinite(found.values).any(axis=0)
    usual[shown] = np.nanmedian(found.values[:, shown], axis=0)
    model = fit.model.with_values(dict(zip(found.names, map(float, usual), strict=True)))
    each = np.where(np.isfinite(found.values), found.values, usual)
    return model.each_experiment(*names).with_values({found.names[place]: each[:, place] for place in places})


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
