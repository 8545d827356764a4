"""A sampled channel, and the checks of what it may hold."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float64

from ._errors import RecordingError

INPUTS: Mapping[str, str] = MappingProxyType({"current": "A", "disturbance_force": "N"})
OUTPUTS: Mapping[str, str] = MappingProxyType({"cart_position": "m", "arm_velocity": "rad/s", "arm_angle": "rad"})

INTERSAMPLE = ("zoh", "foh", "bl")
# In SI units nothing on a rig is that large, and sums of squares of squares of such values are still numbers.
LARGEST = 1e50


def rebuild(record: Any) -> tuple[Any, ...]:
    """Return the class and the field values of a frozen record, as pickling needs them."""
    # A read-only mapping cannot be pickled, so a record is rebuilt from its fields, which checks it again.
    values = (getattr(record, field.name) for field in fields(record))
    plain = (dict(value) if isinstance(value, MappingProxyType) else value for value in values)
    return type(record), tuple(plain)


def finite(place: str, value: Any, meaning: str) -> float:
    """Return `value` as a finite float.

    Raises:
        RecordingError: it is not; names `place`.
    """
    if isinstance(value, (bool, np.bool_, str, bytes)):
        raise RecordingError(f"{place}: {meaning} is {value!r}, but must be a finite number; give it as a float.")
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise RecordingError(f"{place}: {meaning} is {value!r}, but must be a finite number; give it as a float.")
    return number


def positive(place: str, value: Any, meaning: str) -> float:
    """Return `value` as a positive float.

    Raises:
        RecordingError: it is not; names `place`.
    """
    number = finite(place, value, meaning)
    if number <= 0:
        raise RecordingError(f"{place}: {meaning} is {number:g}, but must be positive; correct its value or sign.")
    return number


def one_of(place: str, value: object, meaning: str, allowed: tuple[str, ...]) -> None:
    """Refuse a value that is not one of the allowed ones.

    Raises:
        RecordingError: it is not; names `place`.
    """
    if not isinstance(value, str) or value not in allowed:
        names = ", ".join(repr(name) for name in allowed)
        raise RecordingError(f"{place}: {meaning} is {value!r}, but must be one of {names}; choose one of them.")


@dataclass(frozen=True, eq=False)
class Signal:
    """A sampled channel: `values` in `unit`, made read-only. NaN marks a missing sample (outputs only).

    `intersample` says what an input does between samples: "zoh" (held, a computed current), "foh" (straight
    lines) or "bl" (band-limited, a measured current). `noise_std` is the standard deviation of an output's
    sensor noise, in `unit`.

    Raises `RecordingError` when the values are not a one-dimensional array of real numbers.
    """

    values: Float64[np.ndarray, " sample"]
    unit: str
    intersample: str | None = None
    noise_std: float | None = None

    def __post_init__(self) -> None:
        values: Any = self.values
        # An array that nobody can write to needs no copy: a long recording is held in memory once, not twice.
        frozen = isinstance(values, np.ndarray) and not values.flags.writeable and values.flags.owndata
        if not (frozen and values.dtype == np.float64):
            raw = np.asarray(values)
            if raw.dtype.kind not in "fiu":
                raise RecordingError(f"a signal in {self.unit!r} has dtype {raw.dtype}; give it as real numbers.")
            values = np.array(raw, dtype=np.float64)
            values.flags.writeable = False
        if values.ndim != 1:
            raise RecordingError(
                f"a signal in {self.unit!r} has shape {values.shape}, but must have one axis, time; give one channel."
            )
        object.__setattr__(self, "values", values)

    @property
    def varies(self) -> bool:
        """Return whether its values differ: one that reads the same throughout, as an encoder at rest does, tells no noise."""
        present = self.values[~np.isnan(self.values)]
        return len(present) > 0 and bool(np.ptp(present) > 0)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Signal):
            return NotImplemented
        same = all(getattr(self, name) == getattr(other, name) for name in ("unit", "intersample", "noise_std"))
        return same and np.array_equal(self.values, other.values, equal_nan=True)

    def __hash__(self) -> int:
        return hash((self.unit, self.intersample, self.noise_std, len(self.values)))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuild(self)

    def __repr__(self) -> str:
        held = f", {self.intersample}" if self.intersample is not None else ""
        return f"Signal({len(self.values)} samples, {self.unit}{held})"


def _check_unit(place: str, signal: Signal, unit: str) -> None:
    if signal.unit != unit:
        raise RecordingError(f"{place}: the unit is {signal.unit!r}, but {unit!r} was expected; convert the values.")


def _check_size(place: str, signal: Signal) -> None:
    beyond = np.abs(signal.values) > LARGEST  # False where a sample is missing
    if beyond.any():
        index = int(np.argmax(beyond))
        raise RecordingError(
            f"{place}, sample {index}: the value is {signal.values[index]:g} {signal.unit}, which nothing on a rig reaches; "
            "correct the values or their unit."
        )


def check_input(place: str, signal: Signal, unit: str) -> None:
    """Refuse an input of another unit, without a declared hold, or with a value that is not finite.

    Raises:
        RecordingError: names `place` and the sample.
    """
    _check_unit(place, signal, unit)
    one_of(place, signal.intersample, "intersample", INTERSAMPLE)
    if signal.noise_std is not None:
        raise RecordingError(f"{place}: an input has no noise_std; leave it out.")
    bad = ~np.isfinite(signal.values)
    if bad.any():
        index = int(np.argmax(bad))
        raise RecordingError(
            f"{place}, sample {index}: the value is {signal.values[index]}, but an input must be finite "
            "everywhere; repair the sample or cut the experiment there."
        )
    _check_size(place, signal)


def check_output(place: str, signal: Signal, unit: str, *, still: bool) -> None:
    """Refuse an output of another unit, with infinite values, or that never moves unless it is `still`.

    Raises:
        RecordingError: names `place` and the sample.
    """
    _check_unit(place, signal, unit)
    if signal.intersample is not None:
        raise RecordingError(f"{place}: an output has no intersample; leave it out.")
    if signal.noise_std is not None:
        positive(place, signal.noise_std, "noise_std")
    values = signal.values
    # The usual case, in two looks at the samples; a missing one makes both comparisons false.
    if -LARGEST <= np.min(values, initial=np.inf) < np.max(values, initial=-np.inf) <= LARGEST:
        return
    infinite = np.isinf(values)
    if infinite.any():
        index = int(np.argmax(infinite))
        raise RecordingError(
            f"{place}, sample {index}: the value is {values[index]}; mark a missing sample with NaN instead."
        )
    _check_size(place, signal)
    present = values[~np.isnan(values)]
    if len(present) == 0:
        raise RecordingError(f"{place}: all {len(values)} samples are missing (NaN); leave the channel out.")
    if not still and present.min() == present.max():
        raise RecordingError(
            f"{place}: all samples are {present[0]:g}, so the sensor was not connected or nothing moved; "
            "leave the channel out (of a CSV file, delete its column), or say so with kind='rest', arm='locked' or cart='clamped'."
        )
