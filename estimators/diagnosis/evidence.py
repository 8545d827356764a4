"""Evidence of a diagnosis: a plain record of everything that was computed, to be saved, loaded, and judged without any model."""

import dataclasses
import json
import os
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from estimators.core.undetermined import UNDETERMINED
from estimators.misspecification.findings import Findings, Score

FORMAT, VERSION = "rtac-evidence", 1


@dataclasses.dataclass(frozen=True)
class EffectTraits:
    """The traits of a class of effects that the selection asks for.

    Attributes:
        contact: whether it acts by contact.
        contains: ids of effects that it contains.
        edge: a parameter and an output, far below whose noise, or below whose travel, the effect is what it contains; empty if
            there is none.
        presupposes: ids of effects beside which it stands.
        resembles: ids of effects that change the motion as it does, whatever their size.
    """

    contact: bool = False
    contains: tuple[str, ...] = ()
    edge: tuple[str, ...] = ()
    presupposes: tuple[str, ...] = ()
    resembles: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class FittedModel:
    """A model with some of the candidates added, fitted to the data by its predictions one sample ahead.

    Attributes:
        number: by which the evidence knows it.
        added: ids of the effects beyond the base model, in the order in which they were added.
        parameters: number of free parameters.
        log_likelihood: of all data.
        by_stretch: the same of each stretch of a second, less a constant that all models share.
        looseness: largest relative standard deviation of a combination of parameters in which each added effect takes part.
        random_force, random_torque: in one sample, as fractions of the rms forces.
        values: of the parameters of the added effects, with standard deviations, SI units.
    """

    number: int
    added: tuple[str, ...]
    parameters: int
    log_likelihood: float
    by_stretch: tuple[float, ...] = ()
    looseness: Mapping[str, float] = dataclasses.field(default_factory=dict)
    random_force: float = 0.0
    random_torque: float = 0.0
    values: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)

    @property
    def random(self) -> tuple[float, float]:
        """Return random force and torque in one sample, as fractions of the rms forces."""
        return self.random_force, self.random_torque

    def leaves_free(self, effect: str) -> bool:
        """Return whether the data leave a parameter of an added effect free."""
        return not self.looseness.get(effect, 0.0) < UNDETERMINED


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """The gain of an effect in each experiment if it is estimated from the others only.

    Attributes:
        gain: in the log-likelihood, by experiment; NaN where the others know nothing of the effect.
        known: fraction of what all experiments know of it that the others know, by experiment.
    """

    gain: tuple[float, ...]
    known: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class SimulationError:
    """The error of a free simulation, beside what random forces would leave of it.

    Attributes:
        error: rms over the noise, by channel.
        shaken: what the random forces of the predictor and the sensors would leave of it.
        signal: rms of the motion over the noise.
        random: force and torque of the predictor in one sample, as fractions of the rms forces.
        unknown: channels whose noise nobody knows, where that of others is known.
    """

    error: Mapping[str, float]
    shaken: Mapping[str, float]
    signal: Mapping[str, float]
    random: tuple[float, float]
    unknown: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Refitting:
    """One refit of a model with a candidate added.

    Attributes:
        before: number of the model.
        way: "filter", "thorough", "equations" or "simulation".
        effect: id.
        shape: of the candidate from which the refit began.
        after: number of the model that came of it; None where it diverged.
    """

    before: int
    way: str
    effect: str
    shape: int
    after: int | None


@dataclasses.dataclass(frozen=True)
class Facts:
    """The facts of the recording that a judgement asks for.

    Attributes:
        samples: number of measured values that count.
        seconds: stretches of a second that these are of.
        experiments: number of them that move.
        rest: whether a rest record tells the noise.
        noise_known: whether the noise of a channel is known apart from any fit.
        samples_per_radian: of the cart's natural swing.
        left_out: fraction of the measured values that do not count.
        noise: standard deviation of each channel's noise, SI units.
        effects: traits of every candidate by id.
        untestable: ids of candidates that the data could not show at any plausible size.
        unfollowed: rms error of the diagnosed fit's simulation over the rms of the motion, of the channel where it is most.
        origins: names of the experiments that what was filtered is, or is a piece of, in its order; empty in evidence of an earlier
            version.
        current_noise: random torque in one sample that the noise of a measured current is, as a fraction of the rms torque; zero
            where nothing shows any.
        travel: way in one sample from rest under the rms force or torque, by output, SI units; empty in evidence of an earlier
            version.
    """

    samples: int
    seconds: int
    experiments: int
    rest: bool
    noise_known: bool
    samples_per_radian: float
    left_out: float = 0.0
    noise: Mapping[str, float] = dataclasses.field(default_factory=dict)
    effects: Mapping[str, EffectTraits] = dataclasses.field(default_factory=dict)
    untestable: tuple[str, ...] = ()
    unfollowed: float = 0.0
    origins: tuple[str, ...] = ()
    current_noise: float = 0.0
    travel: Mapping[str, float] = dataclasses.field(default_factory=dict)

    @property
    def silent(self) -> bool:
        """Return whether most samples do not count, as where a rig rests, and no effect that was asked for could be shown."""
        asked = {i for i, traits in self.effects.items() if not traits.contact}
        return self.left_out > 0.5 and bool(asked) and asked <= set(self.untestable)

    @property
    def stuck(self) -> bool:
        """Return whether most samples do not count, as the model rests there, and its simulation misses most of the motion."""
        return self.left_out > 0.5 and self.unfollowed > 0.5

    def origin(self, place: int) -> str:
        """Return the name of the experiment that the one at this place is, or is a piece of."""
        return self.origins[place] if self.origins else str(place)


@dataclasses.dataclass(frozen=True)
class Evidence:
    """Everything that one diagnosis computed, and by which thresholds it chose what to compute.

    The refits are a graph: every model but a root came of another by adding or taking away one effect.

    Attributes:
        facts: about the recording.
        thorough: whether what raised no alarm was looked at again.
        models: every model that was fitted; the first is the base model.
        coloured: number of the base model with coloured noise, if the data are likelier with it; None if they are not.
        colour_asked: whether that was asked.
        refits: every refit that was tried.
        findings: of the tests of the innovations, by number of the model.
        quiet: scores against the innovations of a predictor with low process noise, by number of the model.
        held_out: by numbers of the model before and the one after.
        simulations: error of a free simulation by number of the model; of the base model that of the diagnosed fit.
        policy: the thresholds by which was chosen what to compute.
        equations: scores by what takes off the equation error, by number of the model; where a fit follows nothing.
        simulated: rms error over the noise, by channel, of a simulation fitted with a candidate more, by number of the model and id
            of the candidate; empty where it cannot be fitted.
        broken_off: what was asked and not computed, as the time that was given was over: candidates by id, and what else.
        unfitted: the candidates among it whose refits beside a model were broken off, by the number of that model.
        laws_first: whether nothing more was looked for where a force of one variable explains what is missing.
    """

    facts: Facts
    thorough: bool
    models: tuple[FittedModel, ...]
    coloured: int | None
    colour_asked: bool
    refits: tuple[Refitting, ...]
    findings: Mapping[int, Findings]
    quiet: Mapping[int, tuple[Score, ...]]
    held_out: Mapping[tuple[int, int], HeldOut]
    simulations: Mapping[int, SimulationError]
    policy: Mapping[str, float | int]
    equations: Mapping[int, tuple[Score, ...]] = dataclasses.field(default_factory=dict)
    simulated: Mapping[tuple[int, str], Mapping[str, float]] = dataclasses.field(default_factory=dict)
    broken_off: tuple[str, ...] = ()
    unfitted: Mapping[int, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    laws_first: bool = False

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the evidence to a file (JSON, with NaN and Infinity as numbers), aside first, and renamed once it is whole.

        Raises:
            OSError: the file cannot be written.
        """
        from rtac_jax.measurement.atomic_write import replacing  # reading and judging evidence need no rtac_jax

        with replacing(path) as aside:
            aside.write_text(json.dumps({"format": FORMAT, "version": VERSION, "evidence": _plain(self)}))
        return Path(path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Evidence":
        """Read evidence that `save` wrote.

        Raises:
            ValueError: the file is not evidence, or of another version.
            OSError: the file cannot be read.
        """
        try:
            found = json.loads(Path(path).read_text(encoding="utf-8"))
        except (json.JSONDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"{path} is no evidence of a diagnosis: {error}") from None
        if not isinstance(found, dict) or found.get("format") != FORMAT:
            raise ValueError(f"{path} is no evidence of a diagnosis; save some with diagnosis.evidence.save(path).")
        if found.get("version") != VERSION:
            raise ValueError(
                f"{path} is evidence of version {found.get('version')}; this version of rtac reads {VERSION}. Diagnose again."
            )
        try:
            return _made(cls, found["evidence"])
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"{path} is damaged: {error!r}") from None


def _plain(value: object) -> Any:
    """Return what JSON can hold: records as dictionaries, mappings as lists of pairs."""
    if dataclasses.is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return [[_plain(key), _plain(one)] for key, one in value.items()]
    if isinstance(value, tuple):
        return [_plain(one) for one in value]
    return value


def _made(kind: Any, value: Any) -> Any:
    """Return what a type says that a value of JSON stands for."""
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        kinds = typing.get_type_hints(kind)
        there = [field for field in dataclasses.fields(kind) if field.name in value]  # what came later has a default
        return typing.cast(Any, kind)(**{field.name: _made(kinds[field.name], value[field.name]) for field in there})
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        known = [part for part in parts if part is not type(None)]
        return value if value is None or len(known) > 1 else _made(known[0], value)
    if origin is tuple:
        each = [parts[0]] * len(value) if parts[-1] is Ellipsis else parts
        return tuple(_made(part, one) for part, one in zip(each, value, strict=True))
    if origin is not None and issubclass(origin, Mapping):
        return {_made(parts[0], key): _made(parts[1], one) for key, one in value}
    return typing.cast(Any, kind)(value)
