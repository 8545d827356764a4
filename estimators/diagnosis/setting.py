"""The setting of one diagnosis: the data, the candidates, and how models with some of them are made."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import reduce

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.closed_form.fit import starting_values
from estimators.closed_form.initial_angle import with_initial_angles
from estimators.core.data import Data, moving, pieces
from estimators.core.fit import Fit
from estimators.core.initial_state import scales_of, space_of, without_angle
from estimators.core.parameter_space import Space
from estimators.core.progress import Progress
from estimators.core.residual import start_rows
from estimators.core.sensor_noise import noise_levels
from estimators.diagnosis.candidate_set import plausible
from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.diagnosis.refit import Refit
from estimators.diagnosis.testability import can_show
from estimators.prediction_error.coloured_noise import Colours, capped, colours_at_rest, with_colours
from estimators.prediction_error.innovations import stretches
from estimators.prediction_error.noise_model import NoiseModel
from rtac_jax import RTAC
from rtac_jax.effects import Effect
from rtac_jax.measurement import Experiment, Recording
from rtac_jax.parameters import declarations
from rtac_jax.programs.arrays import to_jax
from rtac_jax.simulation import Steps

_ROOM = 8  # unknowns are padded to a multiple of this


@dataclasses.dataclass
class Setting:
    """The data, and the candidates at null; `part` says that the fit was of more samples, and compiled nothing of this size.

    Screening simulates one model with all candidates at null; the filter, which costs the cube of the number of states, runs
    on models with no more states than what was added has.
    """

    model: RTAC
    recording: Recording
    absent: dict[str, Effect]
    colours: Colours
    colour_seen: bool
    experiments: list[Experiment]
    data: Data
    prior: NoiseModel
    classes: dict[str, type[Effect]]
    instances: list[Effect]
    substeps: Steps
    start: dict[str, np.ndarray]
    progress: Progress
    policy: DiagnosisPolicy = STANDARD
    part: bool = False

    @property
    def assumed(self) -> tuple[str, ...]:
        """Channels whose noise was taken as coloured although no rest record shows it."""
        return () if self.colour_seen else tuple(self.colours)

    @property
    def samples(self) -> int:
        """Return the number of measured values that count."""
        return int(np.sum(np.asarray(self.data.counted)))

    @property
    def left_out(self) -> float:
        """Fraction of the measured values that do not count."""
        return 1.0 - self.samples / float(np.sum(np.asarray(self.data.present)))

    @property
    def samples_per_radian(self) -> float:
        """Samples in a radian of the cart's swing, or of what shows most if that is faster; random forces average over it."""
        scales = scales_of(self.model, self.experiments)
        # A drive that is slow beside the spring shows most, and is not what random forces have to shake.
        natural = float(np.mean(np.asarray(self.model.body.natural_frequency())))
        return 1.0 / (max(scales.frequency, natural) * scales.sample_time)

    @property
    def current_noise(self) -> float:
        """Return the random torque in one sample that the noise of a measured current is, as a fraction of the rms torque."""
        torque = scales_of(self.model, self.experiments).torque
        return float(np.mean(np.asarray(self.model["torque_constant"]))) * self.recording.current_noise() / torque

    @property
    def travel(self) -> dict[str, float]:
        """Return how far cart and arm get in one sample from rest under the rms force and torque, by output [m, rad]."""
        scales = scales_of(self.model, self.experiments)
        inertia = float(np.mean(np.asarray(self.model["arm_inertia"])))
        half = 0.5 * scales.sample_time**2
        return {"cart_position": half * scales.force / scales.mass, "arm_angle": half * scales.torque / inertia}

    def stretches(self) -> np.ndarray:
        """Return for every sample and experiment the number of the second that it belongs to."""
        return stretches(self.data)


def setting_of(
    fit: Fit,
    recording: Recording,
    classes: Sequence[type[Effect]],
    progress: Progress,
    policy: DiagnosisPolicy = STANDARD,
    *,
    part: bool = False,
) -> Setting:
    """Set up for the model of a fit.

    Args:
        fit: that is diagnosed.
        recording: that it was fitted to, or a part of it.
        classes: of the candidates.
        progress: that is told of every step.
        policy: the thresholds.
        part: whether it is a part.
    """
    model, starts = fit.model, fit.start
    if fit.lost:  # then it ended where nothing holds it, and refits would begin there
        model, starts = starting_values(model, recording), {}
    found = set_up(model, recording, classes, starts, int(fit.statistics["substeps"]), progress, policy)
    return dataclasses.replace(found, part=part)


def set_up(
    model: RTAC,
    recording: Recording,
    classes: Sequence[type[Effect]],
    starts: Mapping[str, np.ndarray],
    substeps: int,
    progress: Progress,
    policy: DiagnosisPolicy = STANDARD,
) -> Setting:
    """Set up for a model; candidates that nothing in the recording could show are passed over."""
    levels = dict(noise_levels(recording.experiments))
    # Of angles that nobody measured the closed form is nearer to the truth than a fit of a model that lacks something: the fit
    # moves them by half a radian where a cable holds the arm, to make up for it.
    experiments = with_initial_angles(model, pieces(moving(recording)), levels)
    scales = scales_of(model, experiments)
    possible: dict[str, type[Effect]] = {}
    instances: list[Effect] = []
    absent: dict[str, Effect] = {}
    for c in classes:
        found = plausible(c, scales)
        if found and can_show(c, experiments):
            possible[c.id] = c
            instances += list(found)
            absent[c.id] = absent_like(found[len(found) // 2])
    colours = capped(colours_at_rest(recording.experiments, policy.colour))
    # The first samples tell the start better than a simulation of a model that may be wrong, except for an angle
    # that nobody measured.
    start = {e.name: starts[e.name] for e in without_angle(experiments) if e.name in starts}
    space = space_of(model, experiments, free=shared(model), start=start)
    prior = NoiseModel.of(levels, recording.experiments, scales, space)
    return Setting(
        model, recording, absent, colours, bool(colours), experiments, Data.of(experiments), prior, possible, instances,
        jnp.asarray(substeps), start, progress, policy,
    )  # fmt: skip


def effect_of(setting: Setting, effect: str, refit: Refit) -> Effect:
    """Return an added effect at its estimated parameters."""
    cls = setting.classes[effect]
    return cls(**{name: refit.values[f"{effect}.{name}"] for name in declarations(cls)})


def model_with(setting: Setting, effects: Sequence[Effect]) -> RTAC:
    """Return the model with these effects, and with the colour of the sensors' noise."""
    return with_colours(reduce(RTAC.__add__, effects, setting.model), setting.colours)


def space_for(setting: Setting, model: RTAC, free: Sequence[str]) -> Space:
    """Return the unknowns of a model with these parameters free."""
    return space_of(model, setting.experiments, free=free, start=setting.start)


def padded_space(setting: Setting, model: RTAC, free: Sequence[str], *, room: int = _ROOM) -> Space:
    """Return the unknowns, padded to a multiple of `room`, so that a few parameters more need no new compilation."""
    space = space_for(setting, model, free)
    active = np.full(max(-(-len(free) // room), 1) * room, len(space.names))
    active[: len(space.active)] = np.asarray(space.active)
    return dataclasses.replace(space, active=to_jax(active))


def by_name(space: Space, other: Space, values: Float[Array, " other"]) -> Float[Array, " parameter"]:
    """Return the values of one space where another has a parameter of that name."""
    known = dict(zip(other.names, np.asarray(values), strict=True))
    return jnp.asarray([known.get(n, v) for n, v in zip(space.names, np.asarray(space.values), strict=True)])


def begun(space: Space, model: RTAC, start: Mapping[str, np.ndarray]) -> Space:
    """Return the space with states at the start where they are known by name."""
    known = zip(start_rows(model), np.asarray(space.start), strict=True)
    return dataclasses.replace(space, start=to_jax(np.stack([start.get(row, first) for row, first in known])))


def shared(model: RTAC) -> list[str]:
    """Return the names of the free parameters that all experiments have in common."""
    return [name for name in model.free if name not in model.per_experiment]


def absent_like(instance: Effect) -> Effect:
    """Return the effect at its null value with the shape of an instance."""
    shape = {
        name: float(np.asarray(getattr(instance, name)))
        for name, declared in declarations(instance).items()
        if declared.null is None
    }
    return type(instance).absent(**shape)
