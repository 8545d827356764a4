"""The colour of the sensors' noise in a diagnosis: as rest and motion tell it, or as the likelihood asks for it."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from estimators.core.data import CHANNELS
from estimators.diagnosis.refit import Refit
from estimators.diagnosis.refitting import fitted
from estimators.diagnosis.setting import Setting, begun, by_name, model_with, space_for
from estimators.diagnosis.workers import Workers
from estimators.prediction_error.coloured_noise import Colours, ColourStates, capped, likeliest_colours, rest_spectra
from estimators.prediction_error.noise_estimation import fit_noise

# Correlation times of sensor noise that are tried, from the middle on, in samples.
_CORRELATION_TIMES = (1.5, 4.0, 10.0, 25.0)
_FITTED = (
    4.0  # times as much, at most, that a colour gains once it and the physics beside it are fitted; twice was seen
)
_CREDIBLE = 3.0  # noise over what fast changes show, from which coloured noise is not believed without a record at rest
_QUIETER = 6.0  # by how much in the logarithm of their variance random forces are lowered for that


def recoloured(setting: Setting, base: Refit) -> tuple[Setting, Refit]:
    """Return the setting with the noise colour that rest and motion make likeliest, and the base model fitted again.

    A rest record of a second or two leaves the correlation time open by a tenth or more, and motion shows that. What the
    model leaves out must not be taken for colour, so the colour stays where the rest records do not speak against it;
    without rest records only the reach of the search bounds it.
    """
    if not setting.colours:
        return setting, base
    spectra = rest_spectra(setting.recording.experiments, setting.policy.colour)
    kept = {name: v for name, v in base.values.items() if name.split(".")[0] != ColourStates.id}
    noise = base.predictor.noise

    def likelihood(colours: Colours) -> float:
        rest = 0.0
        for channel, colour in colours.items():
            if channel in spectra:
                lost = spectra[channel].log_likelihood(*first[channel]) - spectra[channel].log_likelihood(*colour)
                if 2 * lost > setting.policy.bic_gain:
                    return -np.inf
                rest -= lost
        trial = dataclasses.replace(setting, colours=capped(colours))
        model = model_with(trial, []).with_values(kept)
        space = begun(space_for(trial, model, base.free), model, base.start)
        physical, prior = space.physical(space.unconstrained(start=False)), setting.prior.starting(space)
        return rest + fit_noise(model, setting.data, space, physical, prior, noise, setting.substeps).log_likelihood

    first = setting.colours
    best, gained = likeliest_colours(first, likelihood)
    if not gained > 0.0:
        return setting, base
    trial = dataclasses.replace(setting, colours=capped(best))
    model = model_with(trial, []).with_values(kept)
    refit = fitted(trial, (), model, base.free, noise, base.start)
    return (trial, refit) if refit.predictor.log_likelihood > base.predictor.log_likelihood else (setting, base)


def coloured(setting: Setting, base: Refit, workers: Workers, beside: float) -> Setting | None:
    """Return the setting with coloured sensor noise, if that makes the base model's data more likely; else None.

    Rest records would tell; without them the likelihood has to.

    Args:
        setting: with white noise.
        base: the base model.
        workers: compute side by side.
        beside: log-likelihood of a model with effects; none is returned that stays far below it.
    """
    count = np.asarray(setting.data.present).sum(axis=(0, 2))
    times = np.unique(np.outer(np.unique(np.asarray(setting.data.excitation.sample_time)), _CORRELATION_TIMES))
    best: Colours = {}
    likelihood, price = base.predictor.log_likelihood, float(np.log(setting.samples))  # of the correlation time
    for channel in np.array(CHANNELS)[count > 0]:
        trials: list[Colours] = [{**best, str(channel): (1.0, float(correlation_time))} for correlation_time in times]
        place, value = _likeliest(
            lambda several: workers.each(lambda c: _likelihood_with(setting, c, base), several), trials
        )
        if 2 * (value - likelihood) - price > setting.policy.bic_gain:
            likelihood, best = value, trials[place]
    gained = likelihood - base.predictor.log_likelihood
    return (
        dataclasses.replace(setting, colours=capped(best))
        if best and gained * _FITTED >= beside - base.predictor.log_likelihood
        else None
    )


def _likeliest(
    likelihoods: Callable[[Sequence[Colours]], Sequence[float]], trials: Sequence[Colours]
) -> tuple[int, float]:
    """Return the likeliest of several colours and its log-likelihood, climbing from those of middling correlation time."""
    middle = [len(trials) // 2 - 1, len(trials) // 2]
    values = dict(zip(middle, likelihoods([trials[i] for i in middle]), strict=True))
    best = max(values, key=lambda i: values[i])
    step = 1 if best == middle[-1] else -1
    while 0 <= best + step < len(trials):
        (values[best + step],) = likelihoods([trials[best + step]])
        if values[best + step] <= values[best]:
            break
        best += step
    return best, values[best]


def assumed_noise(setting: Setting, base: Refit, levels: Mapping[str, float]) -> dict[str, float]:
    """Return the rms of coloured noise that was assumed, by channel; of channels where that is credible beside fast changes.

    Noise that is many times what fast changes show may as well be what a model lacks.

    Args:
        setting: with the colours.
        base: the base model with them.
        levels: of the noise, as fast changes or a record at rest show it.
    """
    sizes = np.exp(0.5 * np.asarray(base.predictor.noise[2:])) * np.asarray(setting.prior.sensor)
    found = {str(c): float(size) for c, size in zip(CHANNELS, sizes, strict=True) if c in setting.assumed}
    return {c: size for c, size in found.items() if c in levels and size <= _CREDIBLE * levels[c]}


def _likelihood_with(setting: Setting, colours: Colours, base: Refit) -> float:
    """Return the log-likelihood of the base model with coloured noise."""
    trial = dataclasses.replace(setting, colours=capped(colours))
    model = model_with(trial, [])
    space = space_for(trial, model, base.free)
    space = dataclasses.replace(space, values=by_name(space, base.space, base.predictor.physical[0]))
    physical = space.physical(space.unconstrained(start=False))
    prior = setting.prior.starting(space)
    # Random forces may stand for what is colour: so from without them, too.
    quiet = np.concatenate([base.predictor.noise[:2] - _QUIETER, base.predictor.noise[2:]])
    return max(
        fit_noise(model, setting.data, space, physical, prior, noise, setting.substeps).log_likelihood
        - space.penalty(physical[0])
        for noise in (base.predictor.noise, quiet)
    )
