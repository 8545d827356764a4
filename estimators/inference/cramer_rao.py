"""The Cramér-Rao bound: the standard deviations to expect of an experiment before it is run."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np

from estimators.core.data import in_channels, moving
from estimators.core.fisher_information import Information, information
from estimators.core.jacobian_factor import diverged, factor
from estimators.core.linearisation import problem_of
from estimators.core.results import DivergedError
from estimators.core.sensor_noise import noise_levels
from estimators.core.step_size import accurate_substeps
from rtac_jax import RTAC, require_configured, simulate
from rtac_jax.arguments import checked_arguments
from rtac_jax.measurement import OUTPUTS, Experiment, Plan, Recording

_FREE = 1e3  # times its value from which on a standard deviation says no more than that nothing is known


@dataclasses.dataclass(frozen=True)
class Expected:
    """The result of `expected_std`.

    Attributes:
        information: covariance and directions, as of a fit to the planned experiments.
        values: of the parameters, which the bound holds for; SI units.
        units: SI units.
    """

    information: Information
    values: Mapping[str, float]
    units: Mapping[str, str]

    @property
    def std(self) -> dict[str, float]:
        """Smallest standard deviation that an unbiased estimate can have, SI units."""
        spread = np.sqrt(np.diagonal(self.information.covariance))
        return dict(zip(self.information.names, (float(s) for s in spread), strict=True))

    def __str__(self) -> str:
        lines = [f"{'parameter':30s} {'value':>12s} {'expected std':>13s} {'fraction':>9s}  unit"]
        for name, std in self.std.items():
            value = self.values[name]
            free = value != 0 and std > _FREE * abs(value)
            shown = "free" if free else f"{std:.2g}"
            fraction = f"{100 * std / abs(value):.2g} %" if value and not free else ""
            lines.append(f"{name:30s} {value:12.5g} {shown:>13s} {fraction:>9s}  {self.units[name]}")
        weak = [*self.information.undetermined(), *self.information.weakest()]
        return "\n".join([*lines, *(f"{text[0].upper()}{text[1:]}." for text in dict.fromkeys(weak))])


@checked_arguments
def expected_std(
    model: RTAC, planned: Recording | Sequence[Experiment | Plan], *, noise: Mapping[str, float] | None = None
) -> Expected:
    """Compute the standard deviations to expect of output error from planned experiments; the model's values are the truth.

    Args:
        model: its free parameters are to be estimated.
        planned: plans; or experiments, of which inputs, lengths, channels and what they show of the start are taken. For a
            plan cart position and arm velocity are taken as measured, and the start as planned.
        noise: standard deviation of each measured channel, SI units; by default what the experiments state or show.

    Returns:
        The bound with the starts of all experiments unknown, as in a fit.

    Raises:
        ValueError: nothing moves, the model has no free parameter, or the noise of a channel is not given.
        DivergedError: the model diverges in these experiments.
        RuntimeError: JAX was not configured for double precision.

    Source: Rao, Bull. Calcutta Math. Soc. 37 (1945); Ljung, System Identification (1999), sections 7.4 and 13.3.
    """
    require_configured()
    if not model.free:
        raise ValueError("The model has no free parameter; release one with model.release(name).")
    items = list(planned.experiments if isinstance(planned, Recording) else planned)
    if any(isinstance(item, Plan) for item in items) and noise is None:
        raise ValueError("a plan shows no noise: give noise={'cart_position': ..., 'arm_velocity': ...} in SI units.")
    experiments = moving(Recording(tuple(_experiment(model, i) if isinstance(i, Plan) else i for i in items)))
    levels = dict(noise) if noise is not None else noise_levels([i for i in items if isinstance(i, Experiment)])
    missing = sorted({c for e in experiments for c in e.outputs} - set(levels))
    if missing:
        raise ValueError(f"the noise of {', '.join(missing)} is not given; add it to noise, in SI units.")
    wrong = [c for c, s in levels.items() if c not in OUTPUTS or not s > 0]
    if wrong:
        raise ValueError(f"noise of {', '.join(wrong)}: give a positive number for one of {', '.join(OUTPUTS)}.")
    deviation = in_channels(levels)
    problem = problem_of(model, experiments, deviation, substeps=1)
    arguments = problem.arguments
    steps = accurate_substeps(model, arguments.data, arguments.space, problem.unknowns, deviation)
    found = factor(problem.unknowns, dataclasses.replace(arguments, substeps=jnp.asarray(steps)))
    if diverged(found):
        raise DivergedError(
            "The model diverges in the planned experiments; look at its values, or plan smaller inputs."
        )
    known = information(np.asarray(found), arguments.space, problem.unknowns)
    values = {n: float(np.asarray(model[n])) for n in known.names}
    return Expected(known, values, {n: model.parameters[n].unit for n in known.names})


def _experiment(model: RTAC, plan: Plan) -> Experiment:
    """Return a plan as the experiment that the model expects of it."""
    asked = plan.to_simulate()
    if plan.kind == "rest":
        return asked
    shown = simulate(model, asked, start={plan.name: plan.start})
    return plan.experiment({channel: np.asarray(getattr(shown, channel)) for channel in asked.outputs})
