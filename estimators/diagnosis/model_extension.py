"""Extension of a model by effects: fitted by three estimators, of which held-out experiments choose one, or none."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Literal, NamedTuple

import numpy as np

from estimators.core.data import Data, in_channels, mark_of, moving, pieces
from estimators.core.deadline import Deadline
from estimators.core.fit import FAR, Fit
from estimators.core.results import FAILURES, RESULTS, DivergedError, NotIdentifiableError
from estimators.core.step_size import accurate_substeps
from estimators.diagnosis.gross_effects import begun_by_equations, placed_inside
from estimators.diagnosis.held_estimates import counting_held
from estimators.diagnosis.policy import STANDARD, SURE, DiagnosisPolicy
from estimators.inference.shaken_simulation import unfollowed
from estimators.output_error.fit import output_error
from estimators.output_error.fit_what_shows import with_alike
from estimators.prediction_error.fit import PredictorFit, prediction_error_nonlinear
from estimators.validation.predictive_likelihood import OneStepAhead, one_step_ahead
from estimators.validation.simulation_error import Compared, compare
from rtac_jax import RTAC
from rtac_jax.effects import Effect
from rtac_jax.measurement import Recording

Way = Literal["simulated", "held", "predicted"]
_LOOSE = 0.1  # deviation over value from which on a parameter is not well known
WAYS: tuple[Way, ...] = ("simulated", "held", "predicted")
"""Ways of fitting a model with effects more, in the order in which they are tried."""


@dataclasses.dataclass(frozen=True)
class PredictedGain:
    """The gain in predictions one sample ahead by effects that no simulation of the held-out experiments shows.

    Attributes:
        id: of the effect; of several that were added together, one after the other.
        gain: in the log-likelihood of the held-out experiments.
        before, after: rms of the predictions' errors over the sensor's noise, by channel.
    """

    id: str
    gain: float
    before: Mapping[str, float]
    after: Mapping[str, float]

    @property
    def channel(self) -> str:
        """Return the channel in which the predictions gain most."""
        return max(self.before, key=lambda c: self.before[c] / self.after[c])

    def __str__(self) -> str:
        where = self.channel
        return (
            f"{self.id} is kept for what it foresees: a simulation of the held-out experiments does not tell, as where random "
            f"forces or an arm that tumbles carry it away, but one sample ahead they are predicted better with it (log-likelihood "
            f"{self.gain:+.0f}, error of {where} {self.before[where]:.2f} to {self.after[where]:.2f} times the noise)."
        )


@dataclasses.dataclass(frozen=True)
class Added:
    """A model with one effect more, or several.

    Attributes:
        fit: of it.
        tested: against the held-out experiments.
        way: all parameters fitted by simulation; those of what was added held at the estimate of the diagnosis; or all fitted by
            predictions one sample ahead.
        predicted_gain: what predictions gain, where a simulation does not tell.
    """

    fit: Fit
    tested: Compared
    way: Way
    predicted_gain: PredictedGain | None = None


class _Begin(NamedTuple):
    """Values of a model at which a fit begins, and states at the start by experiment; None for what the first samples show."""

    model: RTAC
    start: Mapping[str, np.ndarray] | None = None


def add_effects(
    before: Fit,
    tested: Compared,
    several: Sequence[Effect],
    label: str,
    train: Recording,
    held_out: Recording,
    *,
    deviations: Mapping[str, float],
    values: Mapping[str, float] | None = None,
    ways: Sequence[Way] = WAYS,
    unseen: Sequence[str] = (),
    policy: DiagnosisPolicy = STANDARD,
    progress: bool,
) -> Added | str:
    """Return the model with effects more that serves the held-out experiments better, or why there is none.

    Args:
        before: the model without it.
        tested: that against the held-out experiments.
        several: effects at the estimate of the diagnosis, that are added together.
        label: for the comparison.
        train: the recording that is fitted.
        held_out: the recording that validates.
        deviations: standard deviations of the effects' parameters as the diagnosis estimated them, by name; those of what is
            held count them.
        values: of all parameters as the diagnosis estimated them, for where the model without the effects is far from the data.
        ways: of fitting it that are tried; by predictions it is kept only if all are.
        unseen: names of parameters that are held as they show nowhere in what is fitted: they follow the other direction.
        policy: the thresholds by which it is kept.
        progress: show bars.

    Raises:
        OutOfTimeError: the deadline that is kept was over before it was fitted.
    """
    ids, names = [effect.id for effect in several], ", ".join(effect.id for effect in several)
    known = {**before.held, **deviations}
    extended = begun_by_equations(before, reduce(RTAC.__add__, several, before.model), train, policy)
    begins = [_Begin(extended)]
    if values is not None and before.farthest > FAR:
        begins = _nearest_first([extended, placed_inside(extended, values)], train)
    bases = [Added(before, tested, "simulated")]
    steps: list[Added] = []
    reasons = []
    for way in ways:
        try:
            if way == "predicted":
                # The model without the effect is fitted so too, or the effect would be credited with what the estimator does.
                base = _predicted(before.model, before, train, progress=progress)
                bases.append(Added(base, compare(base, held_out, hold_diverging=True).models[0], way))
                fit = with_alike(_predicted(extended, before, train, progress=progress), train, unseen)
            else:
                held = [_Begin(holding(extended, ids))]
                fit = _fitted(begins if way == "simulated" else held, train, progress=progress)
                fit = with_alike(counting_held(fit, train, known), train, unseen)
            with Deadline().kept():  # what is fitted is compared
                test = compare(fit, held_out, labels=[label]).models[0]
        except FAILURES as error:
            said = str(error) if not isinstance(error, np.linalg.LinAlgError) else "it follows next to nothing."
            reasons.append(f"Stopped: with {names} the model could not be fitted: {said}")
            continue
        if before.farthest <= FAR and (loosened := _loosened(before, fit)):
            # Held at any size it would make these numbers sure ones.
            return f"Stopped: with {names} the data no longer tell {', '.join(loosened)}, so it is not added."
        steps.append(Added(fit, test, way))
        if falls_clearly(min((one.tested for one in bases), key=misfit), test, policy, way):
            return steps[-1]
        if way == "simulated" and _follows_at_last(before, fit, test, train, policy):
            return steps[-1]
        reasons.append(f"Stopped: with {names} the held-out error would not fall.")
    if not steps or len(ways) < len(WAYS):
        return reasons[0]
    try:
        by_predictions = _by_predictions(names, bases, steps, train, held_out, policy)
    except np.linalg.LinAlgError:  # of a model that follows next to nothing
        return reasons[0]
    return by_predictions or (
        f"{reasons[0]} Held at the estimate of the diagnosis, or fitted by predictions one sample ahead, it would not help "
        "clearly either, and predictions are no better with it."
    )


def _follows_at_last(before: Fit, after: Fit, test: Compared, train: Recording, policy: DiagnosisPolicy) -> bool:
    """Return whether a fit follows what it was fitted to, where the one before followed nothing, and tells some held-out motion.

    What follows nothing may be right by chance of the little that was held out: an arm that has come to rest, or creeps there, is
    followed by one that is held fast by friction of a hundred times its own.
    """
    data = Data.of(pieces(moving(train)))
    left, now = (unfollowed(fit, data, policy.simulation) for fit in (before, after))
    told = all(error.fit_percent > 0 for error in test.errors.values())
    return left > policy.unfollowed >= now and now <= policy.static * left and told


def _loosened(before: Fit, after: Fit) -> list[str]:
    """Return the parameters that a fit knew well, and that another one no longer does: within a tenth of what they were.

    Asked of a fit that follows the rig: what another one knows is the parameter of another motion. One that is small now is none
    of them: what it stood for may be in the model.
    """
    known = {name: p for name, p in before.parameters.items() if 0 < p.std < _LOOSE * abs(p.value)}
    now = {name: p for name, p in after.parameters.items() if name in known}
    most = {n: max(_LOOSE * max(abs(p.value), abs(known[n].value)), known[n].std / _LOOSE) for n, p in now.items()}
    return sorted(n for n, p in now.items() if not p.std <= most[n])


def _nearest_first(several: Sequence[RTAC], train: Recording) -> list[_Begin]:
    """Return models by how well their simulations follow a recording, the best first, with the states at the start that do."""

    def simulated(model: RTAC) -> tuple[float, _Begin]:
        try:
            compared = compare(model, train).models[0]
        except DivergedError:
            return np.inf, _Begin(model)
        return misfit(compared), _Begin(model, compared.start)

    return [begin for _, begin in sorted(map(simulated, several), key=lambda found: found[0])]


def _fitted(begins: Sequence[_Begin], train: Recording, *, progress: bool) -> Fit:
    """Return the fit by simulation from the first of one or more models from which there is one.

    Raises:
        NotIdentifiableError, DivergedError, FloatingPointError: from none there is; what the last says.
    """
    *others, last = begins
    for begin in others:
        with contextlib.suppress(*FAILURES):
            return _determined(begin, train, progress=progress)
    return _determined(last, train, progress=progress)


def _determined(begin: _Begin, train: Recording, *, progress: bool) -> Fit:
    fit = output_error(begin.model, train, from_model=True, start=begin.start, progress=progress)
    if fit.lost:
        raise NotIdentifiableError(fit.outcome)
    return fit


def extended_without(
    last: Added, given_up: Sequence[str], several: Sequence[Effect], label: str, train: Recording, held_out: Recording, *,
    progress: bool,
) -> Added | None:  # fmt: skip
    """Return a model, fitted by simulation, without some effects or with others in their place; None where it cannot be fitted.

    Args:
        last: the model.
        given_up: ids of the effects that it loses.
        several: effects that it gets, at the values where the fit begins.
        label: for the comparison.
        train: the recording that is fitted.
        held_out: the recording that validates.
        progress: show bars.
    """
    try:
        model = reduce(RTAC.__add__, several, last.fit.model.without(*given_up))
        fit = output_error(model, train, from_model=True, progress=progress)
        return None if fit.lost else Added(fit, compare(fit, held_out, labels=[label]).models[0], "simulated")
    except FAILURES:
        return None


def is_sure(fit: Fit, effect: str) -> bool:
    """Return whether a fit shows an effect, by its id: whether any of its sizes is more than its deviations allow for nothing."""
    amplitudes = next(one for one in fit.model.effects if one.id == effect).amplitudes()
    sizes = [fit.parameters[f"{effect}.{name}"] for name in amplitudes]
    return any(abs(size.value) > SURE * size.std for size in sizes)


def _by_predictions(
    names: str,
    bases: Sequence[Added],
    steps: Sequence[Added],
    train: Recording,
    held_out: Recording,
    policy: DiagnosisPolicy,
) -> Added | None:
    """Return the model that predicts the held-out experiments best one sample ahead; None if none is better.

    For models whose simulation does not tell.
    """
    tested = bases[0].tested
    first = one_step_ahead(bases[0].fit, train, held_out, tested.start)

    def ahead(one: Added) -> OneStepAhead:
        return one_step_ahead(one.fit, train, held_out, tested.start, like=first)

    known = max((ahead(one) for one in bases), key=_likelihood)
    several = [(one, ahead(one)) for one in steps]
    step, best = max(several, key=lambda pair: _likelihood(pair[1]))
    if best.surpasses(known, of=len(several), level=policy.ahead_level):
        gain = best.log_likelihood - known.log_likelihood
        return dataclasses.replace(step, predicted_gain=PredictedGain(names, gain, known.errors, best.errors))
    freely, its = several[0]
    if (
        freely.way == "simulated"
        and misfit(freely.tested) <= misfit(tested)
        and not known.surpasses(its, level=policy.ahead_level)
    ):
        return freely
    return None


def _likelihood(one: OneStepAhead) -> float:
    return one.log_likelihood if np.isfinite(one.log_likelihood) else -np.inf


def _predicted(model: RTAC, before: Fit, train: Recording, *, progress: bool) -> Fit:
    """Fit a model by its predictions one sample ahead, with the starts from which its simulation follows best."""
    found = prediction_error_nonlinear(model, train, from_model=True, progress=progress)
    experiments, space = found.problem.experiments, found.problem.arguments.space
    states = np.asarray(space.physical(found.problem.unknowns)[2])
    compared = compare(found.model, train).models[0]
    start = {e.name: compared.start.get(e.name, states[:, i]) for i, e in enumerate(experiments)}
    return dataclasses.replace(
        before,
        model=found.model,
        result=RESULTS.successful,
        information=found.information,
        residual_std={channel: error.rms for channel, error in compared.errors.items()},
        start=start,
        experiments=found.experiments,
        statistics={
            "log_likelihood": found.log_likelihood,
            "steps": 0,
            "starts": 1,
            "agreed": 1,
            "winner": "predictions one sample ahead",
            "failures": (),
            "substeps": _simulation_steps(found, before.noise),  # predictions need fewer
            "seconds": found.statistics["seconds"],
        },
        marks={e.name: mark_of(e) for e in experiments},
        held={},  # the deviations are those of the predictions, for what is held as it is
    )


def _simulation_steps(found: PredictorFit, levels: Mapping[str, float]) -> int:
    """Return the integration steps in a sample that a free simulation of a model needs which was fitted by predictions."""
    arguments = found.problem.arguments
    noise = in_channels(levels)
    return accurate_substeps(found.model, arguments.data, arguments.space, found.problem.unknowns, noise)


def holding(model: RTAC, effects: Sequence[str]) -> RTAC:
    """Return the model with all parameters of these effects, by id, held at their values."""
    return model.fix(*parameters_of(model, effects))


def parameters_of(model: RTAC, effects: Sequence[str]) -> list[str]:
    """Return the names of the parameters of these effects, by id."""
    return [name for name in model.parameters if name.split(".")[0] in effects]


def falls_clearly(before: Compared, after: Compared, policy: DiagnosisPolicy, way: str = "simulated") -> bool:
    """Return whether the error falls by a twentieth.

    Near the noise, where the effect is simply fitted, any fall will do.
    """
    error, first = misfit(after), misfit(before)
    return error <= (1 - policy.fall) * first or (way == "simulated" and error <= first and error < policy.near_noise)


def misfit(compared: Compared) -> float:
    """Return the mean over the channels of the error in units of the noise.

    In a mean no channel can hide another.
    """
    errors = [e.rms_over_noise for e in compared.errors.values()]
    return sum(errors) / len(errors)
