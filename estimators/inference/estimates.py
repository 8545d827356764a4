"""Estimators of the same physics from one recording, each as a function of the measurements."""

import dataclasses
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators.closed_form.fit import closed_form
from estimators.closed_form.table1 import ClosedForm
from estimators.core.data import moving
from estimators.core.fit import Fit
from estimators.core.jacobian_factor import plain_residual
from estimators.core.linearisation import Problem, at_fit, rows_at, with_outputs
from estimators.core.sensor_noise import noise_levels
from estimators.inference.bootstrap import Outputs, Source, measured_again
from estimators.linear.fit import LinearModels
from estimators.linear.model_sets import Scale
from estimators.linear.operating_conditions import conditions, stacked
from estimators.linear.predictor import rows
from estimators.prediction_error.filter_pass import all_trusted, run_filter
from estimators.prediction_error.fit import PredictorFit
from rtac_jax import RTAC
from rtac_jax.measurement import Recording

Result = ClosedForm | Fit | PredictorFit | LinearModels
Vector = Float[np.ndarray, " quantity"]

MODAL = ("natural frequency", "damping ratio")
"""What a linear model and the physics have in common: of the cart on its spring, with the arm's reaction left to the bias."""
_UNITS = dict(zip(MODAL, ("rad/s", "1"), strict=True))


@dataclasses.dataclass(frozen=True)
class Estimator:
    """An estimator with its result and its dependence on the measurements.

    Attributes:
        label: its name.
        asks: what the model must be right for, in words.
        names: of the quantities that it estimates: parameters, and `MODAL` where a linear model takes part.
        units: of those.
        values: as they came out.
        again: as they would come out from other measurements.
        physical: whether parameters of the physics are among them.
    """

    label: str
    asks: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Vector
    again: Callable[[Outputs], Vector]
    physical: bool


def label_of(result: Result) -> str:
    """Return the name of this kind of estimate."""
    return {
        ClosedForm: "closed form",
        Fit: "output error",
        PredictorFit: "prediction error",
        LinearModels: "linear prediction error",
    }[type(result)]


def estimator_of(result: Result, label: str, source: Source, recording: Recording, *, modal: bool) -> Estimator:
    """Return an estimator as a function of the measurements.

    A closed form is computed anew; the others take one Gauss-Newton step from where they are.

    Args:
        result: of one of the estimators.
        label: the estimator's name.
        source: of the replicates.
        recording: that the result was made from.
        modal: give natural frequency and damping ratio of the cart beside the parameters.

    Raises:
        ValueError: no condition of a linear fit shows the cart's mode.
    """
    if isinstance(result, LinearModels):
        return _linear(result, label, source, recording)
    if isinstance(result, ClosedForm):
        names, values, again = _closed(result, source, recording)
        asks, model = "each moment by itself", result.model
    else:
        problem = at_fit(result, recording) if isinstance(result, Fit) else result.problem
        names, model = problem.names, result.model
        values = np.array([result.parameters[n].value for n in names])
        if isinstance(result, Fit):
            asks, again = "the motion over a whole experiment", _simulated(problem, values)
        else:
            asks, again = "the next sample, given the past", _predicted(result, values)
    units = tuple(model.parameters[n].unit for n in names)
    if modal and "spring_stiffness" in names:
        return Estimator(
            label, asks, (*names, *MODAL), (*units, *_UNITS.values()), _with_modal(model, names, values),
            lambda measured: _with_modal(model, names, again(measured)), True,
        )  # fmt: skip
    return Estimator(label, asks, names, units, values, again, True)


def _closed(
    result: ClosedForm, source: Source, recording: Recording
) -> tuple[tuple[str, ...], Vector, Callable[[Outputs], Vector]]:
    experiments = moving(recording)
    levels = noise_levels(recording.experiments)
    names = tuple(result.estimates)

    def again(values: Outputs) -> np.ndarray:
        measured = measured_again(experiments, source, values)
        found = closed_form(result.model, measured, levels, result.options, settled=True)
        return np.array([found.estimates[n].pooled if n in found.estimates else np.nan for n in names])

    return names, np.array([result.estimates[n].pooled for n in names]), again


def _simulated(problem: Problem, here: Vector) -> Callable[[Outputs], Vector]:
    """Return a Gauss-Newton step; the Jacobian of a simulation does not depend on what was measured."""
    rows = rows_at(problem)
    step = -np.linalg.solve(rows.gauss_newton, rows.jacobian.reshape(-1, len(here)).T)
    by_constants = -np.linalg.solve(rows.gauss_newton, rows.known.T @ rows.known_residual)

    def again(values: Outputs) -> np.ndarray:
        arguments = with_outputs(problem, jnp.asarray(np.nan_to_num(values)))
        return here + by_constants + step @ np.asarray(plain_residual(problem.unknowns, arguments)[0]).ravel()

    return again


def _predicted(fit: PredictorFit, here: Vector) -> Callable[[Outputs], Vector]:
    """Return a Gauss-Newton step with gains along the new measurements, on which the arm may take another path."""
    problem, space = fit.problem, fit.problem.arguments.space
    physical = space.physical(problem.unknowns)

    def again(values: Outputs) -> np.ndarray:
        a = with_outputs(problem, jnp.asarray(np.nan_to_num(values)))
        a = dataclasses.replace(a, data=all_trusted(a.data))
        passed = run_filter(a.model, a.data, space, physical, fit.prior, fit.noise_exponents, a.substeps)
        # Dry friction is shaken loose at other samples than in the recording.
        whitener = passed.whitener * (1.0 - passed.shaken)[:, None, None]
        a = dataclasses.replace(a, whitener=whitener, gain=passed.gain)
        rows = rows_at(problem._replace(arguments=a))
        flat = rows.jacobian.reshape(-1, len(here))
        slope = flat.T @ rows.residual.ravel() + rows.known.T @ rows.known_residual
        return here - np.linalg.solve(rows.gauss_newton, slope)

    return again


def _with_modal(model: RTAC, names: Sequence[str], values: Vector) -> np.ndarray:
    """Return the values, and the natural frequency [rad/s] and damping ratio of a cart coupled to no arm, that slides."""
    at = dict(zip(names, values, strict=True))

    def of(name: str) -> float:
        return at[name] if name in at else float(np.mean(np.asarray(model[name]))) if name in model.parameters else 0.0

    mass, stiffness = of("total_mass"), of("spring_stiffness")
    frequency = np.sqrt(stiffness / mass) if stiffness > 0 else np.nan
    return np.array([*values, frequency, of("cart_viscous.coefficient") / (2 * mass * frequency)])


def _linear(result: LinearModels, label: str, source: Source, recording: Recording) -> Estimator:
    """Return the estimator of the cart's mode, as the median over conditions.

    A mean would not do: a fit that ends without damping is sure of it, and wrong.
    """
    structure, modes = result.structure, result.structure.modes
    theta = np.stack([one.unknowns.theta for one in result.models])
    scale = Scale(*(jnp.asarray([part[i] for part in (m.unknowns.scale for m in result.models)]) for i in range(3)))
    slopes = np.stack([one.unknowns.quantities()[1] for one in result.models])
    values, std = (np.stack([np.asarray(getattr(one, what)) for one in result.models]) for what in ("values", "std"))
    # The cart's mode moves the cart most: of the modes that with the largest static gain beside its uncertainty.
    gains = np.abs(values[:, 2 * modes : 3 * modes])
    places = [(c, int(np.argmax(gains[c]))) for c in range(len(values))]
    rows_of = np.array([[m, modes + m] for _, m in places])
    chosen = np.take_along_axis(values, rows_of, 1)
    usable = np.all(np.isfinite(np.take_along_axis(std, rows_of, 1)), axis=1)
    usable &= np.array([one.converged for one in result.models])
    if not usable.any():
        raise ValueError("no condition of the linear fit shows the cart's mode; leave the linear fit out.")
    gradient = np.take_along_axis(slopes, rows_of[:, :, None], 1)
    rests = tuple(e for e in recording.experiments if e.kind == "rest")

    def again(measured: Outputs) -> np.ndarray:
        found = (*rests, *measured_again(moving(recording), source, measured))
        _, raw, _, present = conditions(Recording(found, rig=recording.rig), **result.options)
        data = dataclasses.replace(stacked(raw, present), scale=scale)
        at = rows(structure, theta, data)
        moved = np.array([-np.linalg.lstsq(j, e, rcond=1e-10)[0] for e, j in zip(*map(np.asarray, at), strict=True)])
        return np.median((chosen + np.einsum("cqt,ct->cq", gradient, moved))[usable], axis=0)

    return Estimator(
        label, "a linear response to the current", MODAL, tuple(_UNITS.values()), np.median(chosen[usable], axis=0), again,
        False,
    )  # fmt: skip
