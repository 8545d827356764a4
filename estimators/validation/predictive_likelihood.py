"""Predictive likelihood of held-out experiments, one sample ahead, for rigs that no simulation can follow."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Array, Float, Int

from estimators.core.data import Data, moving, pieces
from estimators.core.fit import Fit
from estimators.core.initial_state import scales_of, space_of, without_angle
from estimators.core.parameter_space import Space
from estimators.core.sensor_noise import noise_levels
from estimators.prediction_error.coloured_noise import colours_at_rest, with_colours
from estimators.prediction_error.ekf import Filtered
from estimators.prediction_error.filter_pass import run_filter
from estimators.prediction_error.innovations import one_step_rms, stretches
from estimators.prediction_error.noise_estimation import fit_noise
from estimators.prediction_error.noise_model import NoiseModel
from estimators.validation.model_comparison import by_sample, vuong
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment, Recording

_FEWEST = 5  # stretches of data, below which their scatter says nothing
_SEVERAL = 8  # stretches that short data are cut into, so that they scatter; of a second where there are more
_SHORTEST = 0.25  # seconds of a stretch
# Sums over stretches that are shorter than a second are correlated: of differences that are so over 0.3 s, a test at 5 % rejects
# in 17 % of simulations. So it is held to this fraction of the level.
_CAUTION = 0.05
_BARE = 1.0  # gain in log-likelihood, of natural logarithms, that is "not worth more than a bare mention" (Kass and Raftery)


@dataclasses.dataclass(frozen=True)
class OneStepAhead:
    """The predictions of experiments by a model, each sample from all before it.

    Attributes:
        by_sample: log-likelihood of each sample that counts, less a constant.
        stretches: number of the stretch that each sample belongs to: of a second, or shorter where the data are.
        errors: rms of the prediction errors over the sensor's noise, by channel.
        shaken: 1 at stick-slip ambiguous samples, of the recording that was fitted and of this one.
        short: whether stretches are shorter than a second.
    """

    by_sample: Float[np.ndarray, "sample experiment"]
    stretches: Int[np.ndarray, "sample experiment"]
    errors: Mapping[str, float]
    shaken: tuple[Float[np.ndarray, "fitted_sample fitted"], Float[np.ndarray, "sample experiment"]]
    short: bool = False

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of all samples, less a constant."""
        return float(np.sum(self.by_sample))

    def surpasses(self, other: "OneStepAhead", *, of: int = 1, level: float = 0.05) -> bool:
        """Return whether this makes the same samples likelier, by more than chance does and than is worth a bare mention.

        Args:
            other: predictions of the same samples by another model.
            of: number of models of which this is the likeliest.
            level: probability of calling a model better that is not.

        Source: Vuong, Econometrica 57 (1989), on sums over stretches of time, with Student's t for few of them; Kass and Raftery,
        J. Am. Stat. Assoc. 90 (1995).
        """
        count = len(np.unique(self.stretches))
        if count < _FEWEST or self.log_likelihood - other.log_likelihood < _BARE:
            return False
        statistic = vuong(self.by_sample, other.by_sample, self.stretches, 0.0)
        caution = _CAUTION if self.short else 1.0
        return bool(statistic > scipy.stats.t.isf(caution * level / of, count - 1))


def one_step_ahead(
    fit: Fit,
    fitted: Recording,
    recording: Recording,
    starts: Mapping[str, Float[np.ndarray, " state"]],
    *,
    like: OneStepAhead | None = None,
) -> OneStepAhead:
    """Predict a recording, one sample ahead, with a model that was fitted to another one.

    A Kalman filter mends the state at each sample, as far as a random force and a random torque make it doubtful. How large
    these are is estimated where the model was fitted.

    Args:
        fit: to `fitted`.
        fitted: the recording of the fit.
        recording: another one of the same rig.
        starts: states at the start, by experiment, for those in which nobody measured where the arm was; the same for all
            models that are compared.
        like: of another model: what is ambiguous there does not count here either, as likelihoods compare only where they count
            the same samples, and the ambiguous ones tell more of its level than of the rest.

    Source: Ljung, System Identification (1999), section 16.6, on cross-validation by predictions.
    """
    model = fit.model.with_values({name: jnp.mean(fit.model[name]) for name in fit.model.per_experiment})
    model = with_colours(model, colours_at_rest(fitted.experiments))
    substeps = jnp.asarray(int(fit.statistics["substeps"]))
    levels = noise_levels(recording.experiments) | noise_levels(fitted.experiments)
    trained = pieces(moving(fitted))
    space, data = _space(model, trained, fit.start), Data.of(trained)
    prior = NoiseModel.of(levels, fitted.experiments, scales_of(model, trained), space)
    if like is not None:
        data = _counting(data, like.shaken[0])
    fitted_length = data.samples  # arrays have room for more
    noise = fit_noise(model, data, space, _values(space), prior, None, substeps)
    others = pieces(moving(recording))
    space, data = _space(model, others, starts), Data.of(others)
    if like is not None:
        data = _counting(data, like.shaken[1])
    passed = run_filter(model, data, space, _values(space), prior.starting(space), noise.exponents, substeps)
    there = slice(data.samples)
    shaken = (np.asarray(noise.filtered.shaken)[:fitted_length], np.asarray(passed.shaken)[there])
    length = _length(data)
    cut = stretches(data, length)[there]
    return OneStepAhead(by_sample(passed)[there], cut, _errors(passed, levels), shaken, length < 1.0)


def _length(data: Data) -> float:
    """Return how long a stretch is [s]: a second, or less of data so short that they would have too few."""
    sample_time = np.asarray(data.excitation.sample_time, dtype=float) * np.ones(data.experiments)
    there = np.any(np.asarray(data.counted) > 0, axis=1)[:, : data.experiments]
    spans = [float(np.max(np.flatnonzero(column), initial=-1) + 1) for column in there.T]
    return min(1.0, max(float(np.sum(np.array(spans) * sample_time)) / _SEVERAL, _SHORTEST))


def _counting(data: Data, shaken: np.ndarray) -> Data:
    return dataclasses.replace(data, trusted=data.trusted.at[: data.samples].multiply(1.0 - shaken))


def _space(model: RTAC, experiments: Sequence[Experiment], starts: Mapping[str, np.ndarray]) -> Space:
    # The first samples tell the start better than a simulation of a model that may be wrong, but for an unmeasured angle.
    start = {e.name: starts[e.name] for e in without_angle(experiments) if e.name in starts}
    return space_of(model, experiments, free=[], start=start)


def _values(space: Space) -> tuple[Array, Array, Array]:
    return space.physical(space.unconstrained(start=False))


def _errors(passed: Filtered, levels: Mapping[str, float]) -> dict[str, float]:
    return {channel: rms / levels[channel] for channel, rms in one_step_rms(passed).items()}
