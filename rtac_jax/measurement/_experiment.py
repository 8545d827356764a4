"""An experiment on the rig: its inputs, its measured outputs, and its conditions."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from ._errors import RecordingError
from ._signal import INPUTS, OUTPUTS, Signal, check_input, check_output, finite, one_of, positive, rebuild

KINDS = ("free", "forced", "rest")
ARMS = ("free", "locked")
CARTS = ("free", "clamped")
FEWEST_SAMPLES = 8


@dataclass(frozen=True)
class Experiment:
    """One experiment: signals of one common length, sampled every `sample_time` [s].

    `kind` is "free" (released and left alone), "forced" (driven by an input) or "rest" (nothing moves: the
    outputs are sensor noise). `inputs` and `outputs` map names in `INPUTS` and `OUTPUTS` to signals; an
    absent current means that the motor is idle. `initial_arm_angle` is in rad, and so is its standard deviation
    `initial_arm_angle_std`. `repeat_of` names the experiment whose inputs and start this one repeats. `Experiment.of`
    builds one from plain arrays. It is `part` of a longer one where it was cut from that; in a part everything may stand still,
    and no input act.

    Raises `RecordingError` (a `ValueError`) naming the experiment, channel and sample that is wrong.
    """

    name: str
    kind: str
    sample_time: float
    inputs: Mapping[str, Signal]
    outputs: Mapping[str, Signal]
    initial_arm_angle: float | None = None
    arm: str = "free"
    cart: str = "free"
    repeat_of: str | None = None
    initial_arm_angle_std: float | None = None
    part: bool = field(default=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        check_name(self.name)
        place = f"/experiments/{self.name}"
        one_of(place, self.kind, "kind", KINDS)
        one_of(place, self.arm, "arm", ARMS)
        one_of(place, self.cart, "cart", CARTS)
        object.__setattr__(self, "sample_time", positive(place, self.sample_time, "sample_time [s]"))
        if self.initial_arm_angle is not None:
            angle = finite(place, self.initial_arm_angle, "initial_arm_angle [rad]")
            object.__setattr__(self, "initial_arm_angle", angle)
        if self.initial_arm_angle_std is not None:
            if self.initial_arm_angle is None:
                raise RecordingError(
                    f"{place}: initial_arm_angle_std has no initial_arm_angle beside it; give that too, or leave it out."
                )
            spread = positive(place, self.initial_arm_angle_std, "initial_arm_angle_std [rad]")
            object.__setattr__(self, "initial_arm_angle_std", spread)
        named = isinstance(self.repeat_of, str) and self.repeat_of not in ("", self.name)
        if self.repeat_of is not None and not named:
            raise RecordingError(
                f"{place}: repeat_of is {self.repeat_of!r}; name the other experiment that this one repeats."
            )
        for group, known in (("inputs", INPUTS), ("outputs", OUTPUTS)):
            given = getattr(self, group)
            for name, signal in given.items():
                if name not in known:
                    raise RecordingError(
                        f"{place}/{group}/{name}: there is no such channel; use one of {', '.join(known)}."
                    )
                if not isinstance(signal, Signal):
                    raise RecordingError(
                        f"{place}/{group}/{name}: is a {type(signal).__name__}; wrap it in Signal, or use "
                        "Experiment.of."
                    )
            ordered = {name: given[name] for name in known if name in given}
            object.__setattr__(self, group, MappingProxyType(ordered))
        if not self.outputs:
            raise RecordingError(f"{place}/outputs: is empty; give at least one of {', '.join(OUTPUTS)}.")
        self._check_lengths(place)
        for name, signal in self.inputs.items():
            check_input(f"{place}/inputs/{name}", signal, INPUTS[name])
        for name, signal in self.outputs.items():
            still = self.holds(name) or self.part or self.kind == "rest"
            check_output(f"{place}/outputs/{name}", signal, OUTPUTS[name], still=still)
        if self.kind == "forced" and not self.part and not any(signal.values.any() for signal in self.inputs.values()):
            raise RecordingError(
                f"{place}/inputs: a forced experiment needs an input that is not zero throughout; give "
                "current or disturbance_force, or set kind='free'."
            )

    def _check_lengths(self, place: str) -> None:
        first = f"outputs/{next(iter(self.outputs))}"
        for group in ("inputs", "outputs"):
            for name, signal in getattr(self, group).items():
                if len(signal.values) != self.samples:
                    raise RecordingError(
                        f"{place}/{group}/{name}: has {len(signal.values)} samples, but {first} has "
                        f"{self.samples}; all channels of an experiment must have one length, so cut or pad "
                        "them."
                    )
        if self.samples < FEWEST_SAMPLES:
            raise RecordingError(
                f"{place}/{first}: has {self.samples} samples, but at least {FEWEST_SAMPLES} are needed; "
                "record for longer or leave the experiment out."
            )

    @classmethod
    def of(
        cls,
        name: str,
        *,
        kind: str,
        sample_time: float,
        current: ArrayLike | None = None,
        disturbance_force: ArrayLike | None = None,
        cart_position: ArrayLike | None = None,
        arm_velocity: ArrayLike | None = None,
        arm_angle: ArrayLike | None = None,
        intersample: str | Mapping[str, str] = "zoh",
        noise_std: Mapping[str, float] | None = None,
        initial_arm_angle: float | None = None,
        arm: str = "free",
        cart: str = "free",
        repeat_of: str | None = None,
        initial_arm_angle_std: float | None = None,
    ) -> "Experiment":
        """Build an experiment from arrays of shape [N] in SI units (A, N, m, rad/s, rad).

        `intersample` is for all inputs, or a mapping by input; `noise_std` maps outputs to standard
        deviations. Raises `RecordingError` as the class does.
        """
        check_name(name)
        given = {"current": current, "disturbance_force": disturbance_force}
        measured = {"cart_position": cart_position, "arm_velocity": arm_velocity, "arm_angle": arm_angle}
        holds = {key: intersample for key in INPUTS} if isinstance(intersample, str) else dict(intersample)
        noise = dict(noise_std or {})
        for option, mapping, known in (("intersample", holds, INPUTS), ("noise_std", noise, OUTPUTS)):
            for key in mapping:
                if key not in known:
                    raise RecordingError(
                        f"/experiments/{name}: {option} names {key!r}; its channels are {', '.join(known)}."
                    )

        def signal(group: str, key: str, values: ArrayLike, unit: str, **rest: Any) -> Signal:
            try:
                return Signal(np.asarray(values), unit, **rest)
            except ValueError as error:
                raise RecordingError(f"/experiments/{name}/{group}/{key}: {error}") from error

        return cls(
            name=name,
            kind=kind,
            sample_time=sample_time,
            inputs={
                key: signal("inputs", key, values, INPUTS[key], intersample=holds.get(key, "zoh"))
                for key, values in given.items()
                if values is not None
            },
            outputs={
                key: signal("outputs", key, values, OUTPUTS[key], noise_std=noise.get(key))
                for key, values in measured.items()
                if values is not None
            },
            initial_arm_angle=initial_arm_angle,
            arm=arm,
            cart=cart,
            repeat_of=repeat_of,
            initial_arm_angle_std=initial_arm_angle_std,
        )

    def __hash__(self) -> int:
        return hash((self.name, self.kind, self.sample_time, self.samples))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuild(self)

    @property
    def samples(self) -> int:
        """Return the number of samples N."""
        return len(next(iter(self.outputs.values())).values)

    @property
    def time(self) -> Float64[np.ndarray, " sample"]:
        """Time of each sample [s], from zero."""
        return np.arange(self.samples) * self.sample_time

    @property
    def duration(self) -> float:
        """N times the sample time [s]."""
        return self.samples * self.sample_time

    def holds(self, channel: str) -> bool:
        """Return whether an output cannot move, as arm or cart is held."""
        return self.cart == "clamped" if channel == "cart_position" else self.arm == "locked"

    def cut(self, start: int, stop: int, name: str | None = None, *, kind: str | None = None) -> "Experiment":
        """Return samples `start` to `stop` (exclusive) as an experiment of its own.

        The initial arm angle is kept only if `start` is 0, and `repeat_of` is dropped. `kind` is given when
        the part is of another kind, as the decay after a forced start. Within a part the rig may stand still.
        Raises `RecordingError` for samples that do not exist.
        """
        if not 0 <= start < stop <= self.samples:
            raise RecordingError(
                f"/experiments/{self.name}: cannot cut samples {start} to {stop}; choose 0 <= start < stop "
                f"<= {self.samples}."
            )

        def part(signals: Mapping[str, Signal]) -> dict[str, Signal]:
            return {
                key: Signal(signal.values[start:stop], signal.unit, signal.intersample, signal.noise_std)
                for key, signal in signals.items()
            }

        begins = start == 0
        return Experiment(
            name=f"{self.name}[{start}:{stop}]" if name is None else name,
            kind=self.kind if kind is None else kind,
            sample_time=self.sample_time,
            inputs=part(self.inputs),
            outputs=part(self.outputs),
            initial_arm_angle=self.initial_arm_angle if begins else None,
            arm=self.arm,
            cart=self.cart,
            initial_arm_angle_std=self.initial_arm_angle_std if begins else None,
            part=self.part or stop - start < self.samples,
        )


def check_name(name: object) -> None:
    """Refuse what cannot name an experiment, in memory and in a file.

    Raises:
        RecordingError: `name` is not printable text, or holds a slash, or is a single dot.
    """
    if not isinstance(name, str) or not name or name == "." or "/" in name or not name.isprintable():
        raise RecordingError(
            f"/experiments: an experiment is named {name!r}; use printable text without '/', and not '.' alone."
        )
