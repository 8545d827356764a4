"""The specification of a Monte Carlo study: a frozen record that reads and writes TOML."""

import dataclasses
import hashlib
import inspect
import json
import os
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

from estimators.closed_form.fit import least_squares
from estimators.diagnosis.diagnose import diagnose
from estimators.frequency_response.estimate import frequency_responses
from estimators.linear.fit import prediction_error
from estimators.output_error.fit import output_error
from estimators.prediction_error.fit import prediction_error_nonlinear
from estimators.study.declarative import SpecError, Values, freeze_fields, from_table, to_table
from estimators.study.toml_writer import toml
from estimators.uncertainty.envelope import envelope
from rtac_jax import RigidBody
from rtac_jax.effects import CATALOGUE
from rtac_jax.parameters import declarations
from rtac_jax.virtual_rig import Rig

Method = Literal[
    "least_squares",
    "weak_form",
    "output_error",
    "prediction_error_nonlinear",
    "prediction_error",
    "envelope",
    "diagnosis",
]
Statistic = Literal["estimate", "std", "consistency", "quantities"]
STATISTICS: tuple[Statistic, ...] = ("estimate", "std", "consistency", "quantities")

_FORMAT = 3  # of what a repetition keeps: raised when the same study would give other numbers


@dataclasses.dataclass(frozen=True)
class Hidden:
    """The effect that a rig has and the model has not.

    Attributes:
        effect: id of the effect that a diagnosis should name, several joined by " + ", or "nothing".
        values: of fields of the virtual rig, each a number or [low, high], between which it is drawn uniformly;
            `encoder = true` where only a measured angle could show it.
        played: how inputs really run between samples; empty for what the recording says.
    """

    effect: str = "nothing"
    values: Mapping[str, Any] | Values = dataclasses.field(default_factory=Values)
    played: Literal["", "zoh", "foh", "bl"] = ""

    def __post_init__(self) -> None:
        freeze_fields(self, "plant.hidden")


@dataclasses.dataclass(frozen=True)
class Plant:
    """The truth.

    Attributes:
        truth: "virtual_rig", a simulator that shares no code with the model, or "model", the fitted model itself, so that
            nothing but noise stands between it and the data.
        spread: relative deviation of the nine parameters of the paper's model from repetition to repetition [1]: largest where
            they are drawn uniformly, standard where normally.
        distribution: "uniform" or "normal".
        values: that differ from the paper's rig: fields of `virtual_rig.Rig`, or parameters of the model, each a number or
            [low, high]; they are not spread.
        hidden: what is hidden, in turn from repetition to repetition.
    """

    truth: Literal["virtual_rig", "model"] = "virtual_rig"
    spread: float | int = 0.0
    distribution: Literal["uniform", "normal"] = "uniform"
    values: Mapping[str, Any] | Values = dataclasses.field(default_factory=Values)
    hidden: tuple[Hidden, ...] = ()

    def __post_init__(self) -> None:
        freeze_fields(self, "plant")
        if not 0 <= self.spread < 1:
            raise SpecError(f"plant.spread: is {self.spread}; give a fraction of at least 0 and below 1.")
        for place, values in (
            ("plant.values", self.values),
            *((f"plant.hidden[{n}].values", hidden.values) for n, hidden in enumerate(self.hidden)),
        ):
            for name, value in values.items():
                _check_value(f"{place}.{name}", value)
                if self.truth == "virtual_rig" and name not in _RIG:
                    raise SpecError(f"{place}.{name}: the virtual rig has no such field; it has {', '.join(_RIG)}.")


@dataclasses.dataclass(frozen=True)
class Noise:
    """The noise of sensors and random forces, as `virtual_rig.Rig` has it.

    Attributes:
        position, velocity, angle: standard deviations of the sensors [m, rad/s, rad].
        correlation: of the noise of neighbouring samples [1].
        force, torque: random force on the cart and torque on the arm [N/sqrt(Hz), N m/sqrt(Hz)].
        bits: of the virtual rig's converter; 0 for none.
        encoder: whether the arm's angle is measured.
    """

    position: float | int = 2e-5
    velocity: float | int = 0.05
    angle: float | int = 1e-3
    correlation: float | int = 0.0
    force: float | int = 0.0
    torque: float | int = 0.0
    bits: int = 12
    encoder: bool = False

    def __post_init__(self) -> None:
        freeze_fields(self, "noise")


@dataclasses.dataclass(frozen=True)
class Excitation:
    """The experiments of a repetition; several are played in turn from repetition to repetition.

    Attributes:
        name: of the excitation.
        kind: "standard" for `virtual_rig.standard_plans`, "conditions" for operating conditions: multisines of the band about the
            resonance, on an arm that starts near where it pushes most.
        redrawn: other phases and starting places in every repetition.
        duration: of each experiment [s].
        sample_time: [s].
        free, forced, rest, repeats: number of experiments of each kind, for "standard".
        current_rms, largest_current: of the largest current [A].
        intersample: between samples, for "standard".
        conditions: that an envelope is made of, for "conditions".
        new_conditions: of the same population, against which it is held.
        angle: farthest start from 0 or pi [rad].
        band: of the multisine [Hz].
        smallest: amplitudes are drawn from this fraction of the largest to all of it [1].
    """

    name: str = "standard"
    kind: Literal["standard", "conditions"] = "standard"
    redrawn: bool = True
    duration: float | int = 10.0
    sample_time: float | int = 0.005
    free: int = 4
    forced: int = 8
    rest: int = 1
    repeats: int = 0
    current_rms: float | int = 0.16
    largest_current: float | int = 1.2
    intersample: Literal["zoh", "foh", "bl"] = "zoh"
    conditions: int = 8
    new_conditions: int = 20
    angle: float | int = 0.5
    band: tuple[float | int, ...] = (1.0, 5.0)
    smallest: float | int = 1.0

    def __post_init__(self) -> None:
        freeze_fields(self, "excitation")
        if not (self.duration > 0 and self.sample_time > 0):
            raise SpecError("excitation: duration and sample_time must be positive.")
        if len(self.band) != 2 or not 0 < self.band[0] < self.band[1]:
            raise SpecError(f"excitation.band: is {list(self.band)}; give the lower and the upper end in Hz.")

    @property
    def moving(self) -> int:
        """Return the number of experiments in which the rig moves."""
        return self.conditions if self.kind == "conditions" else self.free + self.forced + self.repeats


@dataclasses.dataclass(frozen=True)
class Fitted:
    """The model that is fitted: the paper's, with the rig's mass and inertia known.

    Attributes:
        effects: ids of effects of the catalogue that it has besides.
        free: the parameters that are estimated, the others being held at the truth; empty for all that the data can tell.
        start: where a fit begins: at the "paper"'s values, or at the "truth".
    """

    effects: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    start: Literal["paper", "truth"] = "paper"

    def __post_init__(self) -> None:
        freeze_fields(self, "model")
        for effect in self.effects:
            if effect not in CATALOGUE:
                raise SpecError(
                    f"model.effects: there is no effect {effect!r}; the catalogue has {', '.join(CATALOGUE)}."
                )


@dataclasses.dataclass(frozen=True)
class Estimate:
    """One thing that is done with the data of every repetition.

    Attributes:
        method: an estimator, "envelope" or "diagnosis".
        name: that results show; by default the method.
        options: of the function behind the method, such as `starts` of `output_error`.
    """

    method: Method
    name: str = ""
    options: Mapping[str, Any] | Values = dataclasses.field(default_factory=Values)

    def __post_init__(self) -> None:
        freeze_fields(self, "estimate")
        if not self.name:
            object.__setattr__(self, "name", self.method)
        known = [name for function in functions_of(self.method) for name in _options_of(function)]
        for option in self.options:
            if option not in known:
                raise SpecError(
                    f"estimate.options.{option}: {self.method} has no such option; use one of {', '.join(known)}."
                )


@dataclasses.dataclass(frozen=True)
class StudySpec:
    """A Monte Carlo study.

    Attributes:
        name: of the study.
        question: that it answers.
        repetitions: how often data are made and estimated from.
        seed: of all draws; a repetition depends on it and on its own number alone.
        plant, noise, excitation, model: how data are made, and what is fitted to them.
        estimate: what is done with them.
        keep: which statistics are kept, besides the truth, verdicts, and reasons of failures.

    Raises:
        SpecError: a ValueError that names the field.
    """

    name: str
    repetitions: int
    estimate: tuple[Estimate, ...]
    question: str = ""
    seed: int = 1
    keep: tuple[Statistic, ...] = STATISTICS
    plant: Plant = Plant()
    noise: Noise = Noise()
    excitation: tuple[Excitation, ...] = (Excitation(),)
    model: Fitted = Fitted()

    def __post_init__(self) -> None:
        freeze_fields(self, "")
        if self.repetitions < 1:
            raise SpecError(f"repetitions: is {self.repetitions}; give at least 1.")
        if self.seed < 0:
            raise SpecError(f"seed: is {self.seed}; give a number that is not negative.")
        if not self.estimate:
            raise SpecError("estimate: is empty; name at least one method.")
        if not self.excitation:
            raise SpecError("excitation: is empty; name at least one, or leave it out.")
        for what, records in (("estimate", self.estimate), ("excitation", self.excitation)):
            names = [record.name for record in records]
            if len(set(names)) < len(names):
                raise SpecError(f"{what}: two have one name; give each a name of its own.")
        if self.plant.truth == "model" and (self.noise.force or self.noise.torque or self.noise.correlation):
            raise SpecError(
                'noise: random forces and coloured noise need plant.truth = "virtual_rig"; the model has neither.'
            )
        if self.plant.truth == "model" and any(hidden.values or hidden.played for hidden in self.plant.hidden):
            raise SpecError('plant.hidden: the model hides nothing from itself; use plant.truth = "virtual_rig".')
        for estimate in self.estimate:
            if estimate.method == "envelope" and any(one.kind != "conditions" for one in self.excitation):
                raise SpecError('estimate: an envelope needs excitation.kind = "conditions".')
        if any(one.kind == "conditions" for one in self.excitation) and not self.noise.encoder:
            raise SpecError("noise.encoder: operating conditions need the measured angle; set it to true.")
        if self.plant.truth == "model":
            known = parameter_names(self.model.effects)
            for name in self.plant.values:
                if name not in known:
                    raise SpecError(f"plant.values.{name}: the model has no such parameter; it has {', '.join(known)}.")
        for name in self.model.free:
            if name not in parameter_names(self.model.effects):
                raise SpecError(
                    f"model.free: the model has no parameter {name!r}; it has {', '.join(parameter_names(self.model.effects))}."
                )
        if self.plant.truth == "virtual_rig":
            try:
                Rig(**{n: _middle(v) for n, v in self.plant.values.items()})
            except (ValueError, TypeError) as error:
                raise SpecError(f"plant.values: {error}") from None

    @property
    def digest(self) -> str:
        """Hash of all that the numbers of a repetition depend on: not the name, the question, or how many there are."""
        table = {key: value for key, value in to_table(self).items() if key not in ("name", "question", "repetitions")}
        canonical = json.dumps([_FORMAT, table], sort_keys=True)
        return hashlib.sha256(canonical.encode()).hexdigest()[:16]

    def to_toml(self) -> str:
        """Return the study as TOML, every field stated."""
        return toml(to_table(self))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the study as a TOML file."""
        Path(path).write_text(self.to_toml(), encoding="utf-8")

    @classmethod
    def from_toml(cls, text: str) -> "StudySpec":
        """Return a study from the text of a TOML file.

        Raises:
            SpecError: it is no TOML, a key is unknown or missing, or a value has the wrong type.
        """
        try:
            table = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise SpecError(f"this is not TOML: {error}.") from None
        return from_table(cls, table, "")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "StudySpec":
        """Return a study from a TOML file; errors name the file.

        Raises:
            SpecError: as `from_toml`.
            OSError: the file cannot be read.
        """
        try:
            return cls.from_toml(Path(path).read_text(encoding="utf-8"))
        except (SpecError, UnicodeDecodeError) as error:
            raise SpecError(f"{path}: {error}") from None


def parameter_names(effects: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of all parameters of the paper's model with these effects of the catalogue."""
    own = (f"{effect}.{name}" for effect in (*_PAPER_EFFECTS, *effects) for name in declarations(CATALOGUE[effect]))
    return (*declarations(RigidBody), *own)


def functions_of(method: str) -> tuple[Callable[..., Any], ...]:
    """Return the public functions behind a method, whose arguments are its options."""
    return {
        "least_squares": (least_squares,),
        "weak_form": (least_squares,),
        "output_error": (output_error,),
        "prediction_error_nonlinear": (prediction_error_nonlinear,),
        "prediction_error": (prediction_error,),
        "envelope": (envelope, frequency_responses),
        "diagnosis": (diagnose,),
    }[method]


def options_for(function: Callable[..., Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of the options that a function takes."""
    known = _options_of(function)
    return {name: value for name, value in options.items() if name in known}


_PAPER_EFFECTS = ("cart_viscous", "cart_coulomb", "arm_viscous")
_NOT_OPTIONS = (
    "model",
    "fit",
    "recording",
    "responses",
    "progress",
    "start",
    "angles",
    "realisations",
    "nominal",
    "omega",
)


def _options_of(function: Callable[..., Any]) -> list[str]:
    return [name for name in inspect.signature(function).parameters if name not in _NOT_OPTIONS]


def _check_value(place: str, value: object) -> None:
    """Check that a value is a number or an interval to draw from."""
    if isinstance(value, bool) and place.endswith(".encoder"):
        return
    parts = value if isinstance(value, tuple) else (value,)
    numbers = all(isinstance(part, int | float) and not isinstance(part, bool) for part in parts)
    if not numbers or len(parts) not in (1, 2) or (len(parts) == 2 and not parts[0] <= parts[1]):
        raise SpecError(f"{place}: is {value!r}; give a number, or [low, high] to draw from.")


def _middle(value: object) -> Any:
    return 0.5 * (value[0] + value[1]) if isinstance(value, tuple) else value


# What `Noise` says is not said twice.
_NOISES = ("position_noise", "velocity_noise", "angle_noise", "noise_correlation", "force_noise", "torque_noise")
_RIG = tuple(field.name for field in dataclasses.fields(Rig) if field.name not in (*_NOISES, "quantisation_bits"))
