"""The refits of a diagnosis, with the filter's pass of the last few only: it is most of what a refit holds in memory."""

import dataclasses

import jax.numpy as jnp

from estimators.diagnosis.refit import Refit
from estimators.diagnosis.setting import Setting
from estimators.prediction_error.noise_estimation import run_filter

_PASSES = 4  # that are kept: of 18 x 5,000 samples a pass takes 21 MB, and running it again a sixth of a second


class KeptRefits:
    """Refits by number, each with its setting; a pass that was dropped is run again when it is asked for, to the same bits."""

    def __init__(self, passes: int = _PASSES) -> None:
        """Begin with none.

        Args:
            passes: of the filter that are kept, those of the refits that were used last.
        """
        self._most = passes
        self._refits: list[tuple[Setting, Refit]] = []
        self._recent: list[int] = []  # numbers of refits with a pass, the one used last at the end

    def add(self, setting: Setting, refit: Refit) -> None:
        """Add the refit with the next number."""
        self._refits.append((setting, refit))
        self._used(len(self._refits) - 1)

    def whole(self, number: int) -> tuple[Setting, Refit]:
        """Return the setting and the refit with the filter's pass."""
        setting, refit = self._refits[number]
        if number not in self._recent:
            found, prior = refit.predictor, setting.prior.starting(refit.space)
            passed = run_filter(
                refit.model, setting.data, refit.space, found.physical, prior, found.noise, setting.substeps
            )
            refit = dataclasses.replace(refit, predictor=dataclasses.replace(found, filtered=passed.filtered))
            self._refits[number] = setting, refit
        self._used(number)
        return setting, refit

    def light(self, number: int) -> Refit:
        """Return the refit; of the filter's pass the likelihoods are there, and the rest may be missing."""
        return self._refits[number][1]

    def _used(self, number: int) -> None:
        self._recent = [*(n for n in self._recent if n != number), number]
        while len(self._recent) > self._most:
            oldest = self._recent.pop(0)
            setting, refit = self._refits[oldest]
            self._refits[oldest] = setting, _without_pass(refit)


def _without_pass(refit: Refit) -> Refit:
    """Return a refit that holds only the likelihoods of the filter's pass."""
    nothing = jnp.zeros((0, 0, 0, 0))
    passed = refit.predictor.filtered._replace(
        gain=nothing, whitener=nothing, innovations=jnp.zeros((0, 0, 0)), shaken=jnp.zeros((0, 0))
    )
    return dataclasses.replace(refit, predictor=dataclasses.replace(refit.predictor, filtered=passed))
