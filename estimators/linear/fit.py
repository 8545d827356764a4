"""Prediction error method: linear models of all operating conditions at once."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import control as ct
import jax
import numpy as np
from jaxtyping import Bool, Float, Float64

from estimators.core.drawing import draw
from estimators.core.progress import Progress
from estimators.frequency_response.response import FrequencyResponses
from estimators.linear.homogeneity_test import Covariates, Equality, equality_of
from estimators.linear.initialisation import Pair, pole_pairs
from estimators.linear.model import LinearModel, Unknown
from estimators.linear.model_sets import STRUCTURES, Scale, Structure
from estimators.linear.operating_conditions import conditions, require_enough, stacked
from estimators.linear.predictor import tracks
from estimators.linear.residual_tests import Colour, backward_coloured, residual_test, whitened
from estimators.linear.stages import Stage, predictor_stage, simulation_stages
from rtac_jax import RTAC, linearise, require_configured
from rtac_jax.arguments import checked_arguments
from rtac_jax.measurement import Recording

_MOST_MODES = 3  # that a search tries
_APART = 1e-6  # of the square of a free combination, below which what is not of the noise has no part in it
_FREE = 1e-12  # eigenvalue of the scaled information, relative to the largest, below which a combination is free


@dataclass(frozen=True, eq=False)
class LinearModels:
    """The result of `prediction_error`: one linear model for each condition; iteration and `[name or number]` give one.

    Attributes:
        models: in the order of the recording.
        structure: the model set.
        searched: summed BIC by number of modes, where that was searched.
        seconds: that the fit took.
        options: of `prediction_error` that made the signals.
    """

    models: tuple[LinearModel, ...]
    structure: Structure
    searched: Mapping[int, float]
    seconds: float
    options: Mapping[str, Any]

    def __iter__(self) -> Any:
        return iter(self.models)

    def __len__(self) -> int:
        return len(self.models)

    def __getitem__(self, which: int | str) -> LinearModel:
        if isinstance(which, int):
            return self.models[which]
        for one in self.models:
            if one.name == which:
                return one
        raise KeyError(f"no condition {which!r}; there are {', '.join(one.name for one in self.models)}")

    def transfer_functions(self) -> list[ct.TransferFunction]:
        """Return G of each condition, in continuous time; `envelope` takes them with a grid."""
        return [one.transfer_function() for one in self.models]

    def responses(self, omega: Float[np.ndarray, " frequency"]) -> FrequencyResponses:
        """Return G of each condition on a grid [rad/s] with standard deviations, as `envelope` takes them."""
        return FrequencyResponses(tuple(one.frequency_response(omega) for one in self.models))

    def equality(self, *, level: float = 0.01, covariates: Covariates | None = None) -> Equality:
        """Test whether all conditions have the same parameters; if not, name what drifts, and with which covariate.

        Args:
            level: of significance.
            covariates: further ones, by name and condition, for instance {"temperature": {"run_1": 21.5, ...}}; a drift is
                looked for with these beside the amplitudes of output and input, the arm's angle and the order of time.

        Raises:
            ValueError: fewer than three conditions, or a covariate lacks a value.
        """
        return equality_of(self.models, level, covariates)

    @property
    def aic(self) -> float:
        """Akaike's criterion, summed over conditions, which share no parameter; less a constant."""
        return sum(one.aic for one in self.models)

    @property
    def bic(self) -> float:
        """Return the Bayesian criterion, summed over conditions; less a constant."""
        return sum(one.bic for one in self.models)

    @property
    def verdict(self) -> str:
        """Return the number of conditions that the model set suits, and what is wrong with the others."""
        said: dict[str, list[str]] = {}
        for one in self.models:
            said.setdefault(one.verdict, []).append(one.name)
        return "\n".join(
            f"{len(names)} of {len(self.models)} ({_some(names)}): {text}." for text, names in said.items()
        )

    def __str__(self) -> str:
        kind = self.structure.kind.replace("_", " ")
        lines = [
            f"{kind}, {self.structure.modes} mode(s), {self.structure.zeros} zero(s), noise order {self.structure.noise_order}: "
            f"{len(self.models)} conditions in {self.seconds:.1f} s",
            f"{'condition':16s} {'fit [%]':>8s} {'innovation':>10s}  modes: natural frequency [rad/s], damping ratio",
        ]
        m = self.structure.modes
        for one in self.models:
            shown = "; ".join(
                f"{one.values[k]:.4g} ± {one.std[k]:.1g}, {one.values[m + k]:.3g} ± {one.std[m + k]:.1g}"
                for k in range(m)
            )
            lines.append(f"{one.name:16s} {one.fit_percent():8.2f} {one.innovation_std:10.3g}  {shown}")
        if self.searched:
            least = min(self.searched.values())
            tried = ", ".join(f"{modes}: {bic - least:+.0f}" for modes, bic in self.searched.items())
            lines.append(f"BIC beside the best, by modes: {tried}")
        lines.append(
            f"AIC {self.aic:.1f}, BIC {self.bic:.1f}, summed over conditions, less a constant; FPE in each model's fpe"
        )
        return "\n".join([*lines, self.verdict])

    def plot(self, omega: Float[np.ndarray, " frequency"] | None = None) -> Any:
        """Draw the responses of all conditions with their uncertainty, and the tests of their residuals."""
        return draw(self, omega)


@checked_arguments
def prediction_error(
    recording: Recording,
    *,
    structure: str = "box_jenkins",
    modes: int | str = 1,
    zeros: int | None = None,
    noise_order: int | None = None,
    input: str = "current",
    output: str = "cart_position",
    compensate: bool = True,
    start: RTAC | ct.TransferFunction | ct.StateSpace | None = None,
    detrend: bool = False,
    angles: Mapping[str, Float64[np.ndarray, " sample"]] | None = None,
    model: RTAC | None = None,
    progress: bool = True,
) -> LinearModels:
    """Fit a linear model to each forced experiment, all of them in one batch (paper, section 5.1).

    y = G u + H e, with G in continuous time behind the input's own hold, H in discrete time, and e white. Errors of
    one-step-ahead predictions are made least by damped Gauss-Newton steps; the states of G at the start are estimated, so that
    transients are used. First G is fitted by its simulation error with one mode, then with one more at a time, each begun
    at the pair of poles that explains most of what is left; then H is added.

    With `compensate` the input is x = input * cos(theta) of Fig. 3; `FrequencyResponse.actual` puts cos(theta_0) back.

    Args:
        recording: with forced experiments.
        structure: "output_error", "armax", "box_jenkins" or "state_space"; see `Structure`.
        modes: pairs of poles of G, or "search": the number up to 3 with the least BIC summed over conditions.
        zeros: of G, 2 modes - 2, 2 modes - 1 (the default) or 2 modes; in a search those of one mode.
        noise_order: of C and D; 2 by default, and twice the modes in state space.
        input: name of the input channel.
        output: name of the output channel.
        compensate: count cos(theta) as part of the input.
        start: a model whose poles are tried first, the rig's own linearised about theta = 0, as equation (4), or a
            linear one; beside them poles are searched.
        detrend: take the means off input and output first. The paper advises against it.
        angles: theta(t) [rad] by name of experiment, where it is not measured.
        model: simulates theta(t) where it is neither measured nor given.
        progress: show how far it is, as `core.progress.Progress` does.

    Returns:
        One model for each forced experiment.

    Raises:
        ValueError: an option or channel is unknown, an unstable start, a constant channel, an excitation that vanishes or
            has too few frequencies, or fewer samples than unknowns.
        RuntimeError: JAX was not configured for double precision.

    Source: Ljung, System Identification (1999), chapters 4, 7, 9 and 16.
    """
    require_configured()
    began = time.perf_counter()
    search = modes == "search"
    first = structure_of(structure, 1 if search else modes, zeros, noise_order)
    candidates = _candidates(start)
    options = {
        "input": input, "output": output, "compensate": compensate, "detrend": detrend, "angles": angles, "model": model,
    }  # fmt: skip
    experiments, raw, angle, present = conditions(recording, **options)
    names = [e.name for e in experiments]
    most = _MOST_MODES if search else first.modes
    largest = first.with_modes(most)
    require_enough(first if search else largest, names, raw, present)
    data = stacked(raw, present)
    ended: dict[int, Stage] = {}
    with Progress("linear fits", show=progress, total=2 * most if search else most + 1) as shown:
        for simulated in simulation_stages(largest, data, raw, candidates, most):
            shown.step()
            number = simulated.structure.modes
            if search or number == most:
                ended[number] = predictor_stage(first.with_modes(number) if search else first, simulated)
                shown.step()
    scores = {number: float(np.sum(_criteria(stage)[2])) for number, stage in ended.items()}
    stage = ended[min(scores, key=lambda number: scores[number])]
    sides = [(x, mask, a) for x, mask, a in zip(raw, present, angle, strict=True)]
    found = _models(stage, names, sides, compensate, (input, output))
    return LinearModels(found, stage.structure, scores if search else {}, time.perf_counter() - began, options)


def structure_of(kind: str, modes: int | str, zeros: int | None, noise_order: int | None) -> Structure:
    """Return the model set that the options ask for.

    Raises:
        ValueError: an option is out of range; the message names it.
    """
    if kind not in STRUCTURES:
        raise ValueError(f"structure: is {kind!r}; use one of {', '.join(STRUCTURES)}.")
    if not isinstance(modes, int) or not 1 <= modes <= 6:
        raise ValueError(f"modes: is {modes!r}; give a number from 1 to 6, or 'search'.")
    chosen = 2 * modes - 1 if zeros is None else zeros
    if not 2 * modes - 2 <= chosen <= 2 * modes:
        raise ValueError(f"zeros: is {zeros}; with {modes} mode(s) give from {2 * modes - 2} to {2 * modes}.")
    fixed = {"output_error": 0, "state_space": 2 * modes}
    if kind in fixed and noise_order is not None:
        raise ValueError(f"noise_order: {kind} has none to choose; leave it out.")
    order = fixed.get(kind, 2 if noise_order is None else noise_order)
    if kind not in fixed and not 1 <= order <= 10:
        raise ValueError(f"noise_order: is {order}; give a number from 1 to 10.")
    if kind == "armax" and order > 2 * modes:
        raise ValueError(f"noise_order: is {order}; ARMAX with {modes} mode(s) has at most {2 * modes}.")
    return Structure(kind, modes, chosen, order)


def _candidates(start: RTAC | ct.TransferFunction | ct.StateSpace | None) -> list[Pair]:
    if start is None:
        return []
    if isinstance(start, RTAC):
        poles = np.asarray(linearise(start, delay_order=0).poles()).astype(np.complex128)
        # The arm that turns freely is no part of the response to the cart: its poles lie at zero or near it on the axis.
        return pole_pairs(poles[poles.imag != 0])
    if not isinstance(start, ct.TransferFunction | ct.StateSpace):
        raise ValueError(f"start: is {start!r}; give a model of the rig or a linear system of python-control.")
    return pole_pairs(np.asarray(start.poles()).astype(np.complex128))


def _criteria(stage: Stage) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return FPE, AIC and BIC of each condition."""
    count = np.sum(np.asarray(stage.data.present), axis=1)
    d, value = stage.structure.count, stage.mean_square
    likelihood = count * np.log(np.maximum(value, 1e-300))
    fpe = value * (count + d) / (count - d)
    return fpe, likelihood + 2 * d, likelihood + d * np.log(count)


def _models(
    stage: Stage, names: Sequence[str], sides: Sequence[Any], compensated: bool, channels: tuple[str, str]
) -> tuple[LinearModel, ...]:
    structure = stage.structure
    shown, predictors = tracks(structure, stage.theta, stage.data)
    fpe, aic, bic = _criteria(stage)
    error, jacobian = np.asarray(stage.rows.error), np.asarray(stage.rows.jacobian)
    scales = jax.tree.map(np.asarray, stage.data.scale)
    labels, units = _labels(structure)
    found = []
    for i, (name, (raw, mask, angle)) in enumerate(zip(names, sides, strict=True)):
        count = len(raw.output)
        colour = whitened(error[i, :count])
        covariance, free, idle = _covariance(error[i, :count], jacobian[i, :count], mask, colour, structure)
        # An input that is held shows one sample later at the earliest.
        first = int(raw.intersample == "zoh" and structure.zeros < 2 * structure.modes)
        at = Unknown(structure, stage.theta[i], covariance, Scale(*(part[i] for part in scales)))
        values, slope = at.quantities()
        poles, poles_std, zeros, zeros_std = at.roots()
        static, static_slope = at.response(np.zeros(1))
        here = np.asarray(mask, dtype=float)
        kept = float(np.sum(here)) - structure.count
        found.append(
            LinearModel(
                name=name, structure=structure, names=labels, units=units, values=values,
                covariance=slope @ covariance @ slope.T, poles=poles, zeros=zeros, poles_std=poles_std,
                zeros_std=zeros_std, static_gain=float(static[0, 0]),
                static_gain_std=float(np.sqrt(static_slope[0, 0] @ covariance @ static_slope[0, 0])),
                noise_numerator=np.append(1.0, np.asarray(predictors.c)[i]),
                noise_denominator=np.append(1.0, np.asarray(predictors.d)[i]),
                innovation_std=float(scales.error[i] * np.sqrt(np.sum(error[i] ** 2) / kept) / np.asarray(shown.spread)[i]),
                undetermined=free, converged=bool(stage.converged[i]),
                fpe=float(fpe[i]), aic=float(aic[i]), bic=float(bic[i]),
                residuals=residual_test(
                    error[i, :count], raw.input, here, jacobian[i, :count], colour, noise_parameters=structure.noise,
                    first=first,
                ),
                output=np.where(mask, raw.output, np.nan), simulated=np.asarray(shown.simulated)[i, :count],
                noise_states=np.asarray(shown.noise)[i, :count], signal=raw.input, sample_time=raw.interval,
                arm_angle=angle, compensated=compensated, channels=channels, unknowns=at, idle=idle,
            )
        )  # fmt: skip
    return tuple(found)


def _covariance(
    error: Float[np.ndarray, " sample"],
    jacobian: Float[np.ndarray, "sample unknown"],
    present: Bool[np.ndarray, " sample"],
    colour: Colour,
    structure: Structure,
) -> tuple[Float[np.ndarray, "unknown unknown"], int, int]:
    """Return the covariance of the unknowns, and how many of their combinations the data leave free: of G, and of H alone.

    For output error, whose errors may be coloured, by Ljung's (9.42) with the colour of an autoregression (`whitened`). With a
    model of the noise the errors are white, and of one size, also where samples are missing.
    """
    size = np.linalg.norm(jacobian, axis=0)
    size = np.where(size > 1e-12 * np.max(size), size, np.inf)  # without any effect: nothing else depends on it
    values, vectors = np.linalg.eigh((jacobian / size).T @ (jacobian / size))
    kept = values > _FREE * values[-1]
    begins, count = structure.dynamics, structure.count
    of_noise = np.r_[begins : begins + structure.noise, count - structure.noise_starts : count]
    idle = int(np.sum(np.sum(vectors[of_noise][:, ~kept] ** 2, axis=0) > 1 - _APART))
    free = int(np.sum(~kept)) - idle
    half = vectors[:, kept] / np.sqrt(values[kept]) / size[:, None]
    bread = half @ half.T
    freedom = float(np.sum(present)) - structure.count
    if structure.noise:
        return bread * float(np.sum(error**2)) / freedom, free, idle
    whitening, variance = colour
    rows = backward_coloured(jacobian, whitening)
    factor = variance * len(error) / freedom
    return factor * bread @ (rows.T @ rows) @ bread, free, idle


def _labels(structure: Structure) -> tuple[tuple[str, ...], tuple[str, ...]]:
    numbers = [f" {k + 1}" if structure.modes > 1 else "" for k in range(structure.modes)]
    fast = numbers[:-1] if structure.zeros == 2 * structure.modes - 2 else numbers
    parts = [
        *((f"natural frequency{n}", "rad/s") for n in numbers), *((f"damping ratio{n}", "1") for n in numbers),
        *((f"static gain{n}", "output/input") for n in numbers),
        *((f"rate gain{n}", "output/input rad/s") for n in fast),
    ]  # fmt: skip
    if structure.zeros == 2 * structure.modes:
        parts.append(("feedthrough", "output/input"))
    return tuple(name for name, _ in parts), tuple(unit for _, unit in parts)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
