"""Many experiments on one rig, with what is known about it beforehand."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from os import PathLike, fspath
from pathlib import Path
from types import MappingProxyType
from typing import Any, Unpack

import numpy as np

from rtac_jax.overview import Overview

from . import _csv, _hdf5, _mat
from ._columns import ImportOptions
from ._errors import RecordingError
from ._experiment import Experiment
from ._hum import Hum, without_hum
from ._info import describe
from ._input_noise import current_noise, noise_level
from ._mending import mended
from ._signal import finite, positive, rebuild

POSITIVE = ("total_mass", "arm_inertia", "spring_stiffness", "torque_constant", "eccentric_moment")
STD = "_std"  # ends the name of a constant's standard deviation
HOLD_OUT_EVERY = 4
_DIVIDED = 200  # samples from which the only experiment is cut in two
_LIVELY = 0.5  # rms of an output in the last quarter of a decay over that of the whole, from which on it tells as much
_WRITERS = {".h5": _hdf5.write, ".hdf5": _hdf5.write, ".csv": _csv.write}


@dataclass(frozen=True)
class Recording:
    """Experiments on one rig. `recording["name"]` is one of them; iteration goes through all in order.

    `rig` holds constants known beforehand, named as parameters of the model, in SI units: `total_mass` [kg],
    `arm_inertia` [kg m^2], `spring_stiffness` [N/m], `torque_constant` [N m/A], `eccentric_moment` [kg m],
    ... Given beside one, `NAME_std` is its standard deviation, in the same unit; these are kept in `rig_std`, by
    the name of the constant. A constant without one counts as exact.

    Raises `RecordingError` (a `ValueError`) when there is no experiment, a name occurs twice, a `repeat_of`
    does not hold, or a rig constant or its standard deviation is not a number.
    """

    experiments: tuple[Experiment, ...]
    rig: Mapping[str, float] = field(default_factory=dict)
    rig_name: str = ""
    comment: str = ""
    rig_std: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "experiments", tuple(self.experiments))
        if not self.experiments:
            raise RecordingError("/experiments: is empty; a recording needs at least one experiment.")
        by_name: dict[str, Experiment] = {}
        for experiment in self.experiments:
            if not isinstance(experiment, Experiment):
                raise RecordingError(
                    f"/experiments: a {type(experiment).__name__} was given; build it with Experiment.of."
                )
            if experiment.name in by_name:
                raise RecordingError(f"/experiments/{experiment.name}: the name occurs twice; rename one of the two.")
            by_name[experiment.name] = experiment
        for experiment in self.experiments:
            _check_repeat(experiment, by_name)
        rig = {}
        stated = {n.removesuffix(STD): v for n, v in self.rig.items() if isinstance(n, str) and n.endswith(STD)}
        for name, value in self.rig.items():
            if isinstance(name, str) and name.endswith(STD):
                continue
            if not isinstance(name, str) or not name.isidentifier():
                raise RecordingError(f"/rig: a constant is named {name!r}; use the name of a parameter of the model.")
            slide = name == "spring_stiffness" and value == 0  # which has no spring
            check = positive if name in POSITIVE and not slide else finite
            rig[name] = check(f"/rig/{name}", value, "the constant")
        object.__setattr__(self, "rig", MappingProxyType(rig))
        spread = {name: _deviation(name, value, rig) for name, value in (dict(self.rig_std) | stated).items()}
        object.__setattr__(self, "rig_std", MappingProxyType(spread))
        for name in ("rig_name", "comment"):
            text = getattr(self, name)
            if not isinstance(text, str) or "\0" in text or not _encodable(text):
                raise RecordingError(f"/: {name} is {text!r}; give plain text.")

    @staticmethod
    def load(path: str | PathLike[str]) -> "Recording":
        """Load the recording in an HDF5 file.

        Raises `FileNotFoundError`, or `RecordingError` naming the path inside the file that departs from the
        layout.
        """
        return _hdf5.read(path, Recording)

    def save(self, path: str | PathLike[str]) -> None:
        """Write an HDF5 file, which loses nothing, or a CSV file, which a rig plays and a spreadsheet opens.

        The ending says which: ".h5" and ".hdf5", or ".csv" for a single experiment, with its times and channels in
        columns that the first row names and gives units. A file that was there is replaced only when the new one is
        complete.

        Raises `RecordingError` for another ending, or for several experiments in a CSV file; `FileNotFoundError`
        when there is no such folder.
        """
        ending = Path(path).suffix.lower()
        if ending not in _WRITERS:
            raise RecordingError(f"{fspath(path)}: cannot be written; let the name end in {', '.join(_WRITERS)}.")
        _WRITERS[ending](path, self)

    def overview(self) -> Overview:
        """Return kind, length and channels of every experiment."""
        rows = [
            (e.name, e.kind, str(e.samples), f"{e.sample_time:.6g}", ", ".join([*e.inputs, *e.outputs])) for e in self
        ]
        kinds = [e.kind for e in self]
        counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
        known = ", ".join(f"{name} = {value:.6g}" for name, value in self.rig.items())
        header = ("experiment", "kind", "samples", "sample time [s]", "channels")
        return Overview(
            f"{len(self)} experiments ({counts})",
            header,
            rows,
            (f"Known beforehand: {known or 'nothing'}.", self.comment),
        )

    def __repr__(self) -> str:
        return f"Recording: {self.overview().title}"

    def _repr_html_(self) -> str:
        return self.overview().to_html()

    def __str__(self) -> str:
        return describe(self)

    @staticmethod
    def from_mat(
        path: str | PathLike[str], *, channels: Mapping[str, str], kind: str, **options: Unpack[ImportOptions]
    ) -> "Recording":
        """Import a recording of one experiment from the variables of a MAT file (v5 or v7.3).

        `channels` maps channels to variables, as in `{"disturbance_force": "V1", "cart_position": "V2"}`; each is a vector, or
        names one as in MATLAB: the field of a structure (`out.x`, `scope.signals(2).values`), a column (`log(:,3)`) or a row
        (`ans(2,:)`) of a matrix. Either `sample_time` [s] or `time`, the variable with the times, is given. The other
        options are those of `ImportOptions`.

        Raises `FileNotFoundError`, or `RecordingError` naming the variable, option or sample that is wrong.
        """
        experiment, rig = _mat.read(path, channels, kind, options)
        return Recording((experiment,), rig)

    @staticmethod
    def from_csv(
        path: str | PathLike[str],
        *,
        channels: Mapping[str, str],
        kind: str,
        delimiter: str = ",",
        **options: Unpack[ImportOptions],
    ) -> "Recording":
        """Import a recording of one experiment from the columns of a CSV file that a row above the numbers names.

        A decimal comma is read between quotes, or where another character separates the columns. What is above that row, and
        units below it, is passed over; a file that is not UTF-8 is taken for cp1252.

        `channels` maps channels to columns, as in `{"current": "i_motor", "cart_position": "x"}`. Either `time`,
        the column with the times, or `sample_time` [s] is given. An empty cell and "nan" mean a missing
        sample. The other options are those of `ImportOptions`.

        Raises `FileNotFoundError`, or `RecordingError` naming the row (counted from 1, with the header) and the
        column.
        """
        experiment, rig = _csv.read(path, channels, kind, delimiter, options)
        return Recording((experiment,), rig)

    @staticmethod
    def join(*recordings: "Recording") -> "Recording":
        """Return one recording with the experiments of all, in order, and the rig constants of all.

        Raises `RecordingError` when a name occurs twice, or two recordings disagree about the rig.
        """
        rig: dict[str, float] = {}
        for recording in recordings:
            for name, value in recording.rig_attributes.items():
                if rig.setdefault(name, value) != value:
                    raise RecordingError(
                        f"/rig/{name}: is {rig[name]:g} in one recording and {value:g} in another; these are "
                        "two rigs, or one of the values must be corrected."
                    )
        names = list(dict.fromkeys(part.rig_name for part in recordings if part.rig_name))
        if len(names) > 1:
            raise RecordingError(f"/: rig_name is {names[0]!r} and {names[1]!r}; join recordings of one rig only.")
        comments = dict.fromkeys(part.comment for part in recordings if part.comment)
        experiments = tuple(experiment for part in recordings for experiment in part)
        return Recording(experiments, rig, "".join(names), "\n".join(comments))

    def __getitem__(self, name: str) -> Experiment:
        for experiment in self.experiments:
            if experiment.name == name:
                return experiment
        raise KeyError(f"no experiment {name!r}; there are {', '.join(self.names)}")

    def __len__(self) -> int:
        return len(self.experiments)

    def __iter__(self) -> Iterator[Experiment]:
        return iter(self.experiments)

    def __hash__(self) -> int:
        return hash((self.experiments, self.rig_name))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuild(self)

    @property
    def rig_attributes(self) -> dict[str, float]:
        """Return the constants and, as `NAME_std`, their standard deviations, as a file keeps them."""
        return dict(self.rig) | {f"{name}{STD}": value for name, value in self.rig_std.items()}

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the experiments, in order."""
        return tuple(experiment.name for experiment in self.experiments)

    def select(self, names: Iterable[str]) -> "Recording":
        """Return the named experiments, in the order of this recording.

        A repeat whose original is not selected stands alone (`repeat_of` is None).
        Raises `RecordingError` for a name that is not there, and when nothing is selected.
        """
        wanted = self._known(names, "select")
        kept = (experiment for experiment in self if experiment.name in wanted)
        alone = tuple(e if e.repeat_of in wanted else replace(e, repeat_of=None) for e in kept)
        return replace(self, experiments=alone)

    def split(self, validation: Sequence[str] | None = None) -> "tuple[Recording, Recording]":
        """Return `(train, validation)`, split by experiment.

        Without names, every fourth free and every fourth forced experiment is held out, or the last where
        there are two or three of a kind. Repeats go where their original goes, and experiments at rest are
        for training. Raises `RecordingError` when a side would be left without an experiment in motion.
        """
        moving = [experiment for experiment in self if experiment.kind != "rest"]
        if validation is None:
            held = self._every_fourth(moving)
        else:
            held = {self[name].repeat_of or name for name in self._known(validation, "validation")}
            for name in held:
                if self[name].kind == "rest":
                    raise RecordingError(
                        f"/experiments/{name}: is at rest and can validate nothing; name a free or forced experiment."
                    )
        out = {experiment.name for experiment in moving if (experiment.repeat_of or experiment.name) in held}
        if not out:
            raise RecordingError(
                f"/experiments: nothing can be held out of {', '.join(self.names)}, as no kind has two "
                "experiments that do not repeat each other; name those for validation, or cut one in two (Experiment.cut, or "
                "the same file imported twice, with --start and --end)."
            )
        if len(out) == len(moving):
            raise RecordingError(
                f"/experiments: nothing is left for training besides {', '.join(sorted(out))}; name fewer "
                "for validation, or cut one in two with Experiment.cut."
            )
        return self.select(name for name in self.names if name not in out), self.select(out)

    def divided(self) -> "Recording":
        """Return the recording with its only moving experiment cut in two, so that the last quarter of it can be held out.

        It is the same where several move, where that one has fewer than 200 samples, and where it is a decay that is over by then.
        """
        moving = [experiment for experiment in self if experiment.kind != "rest"]
        if len(moving) != 1 or moving[0].samples < _DIVIDED:
            return self
        (only,) = moving
        place = only.samples - only.samples // HOLD_OUT_EVERY
        if only.kind == "free" and not any(_is_lively(name, s.values, place) for name, s in only.outputs.items()):
            return self
        parts = only.cut(0, place), only.cut(place, only.samples)
        rest = [experiment for experiment in self if experiment is not only]
        return replace(self, experiments=(*parts, *rest))

    def hum(self) -> tuple[Hum, ...]:
        """Return the hum of the mains in the outputs, as sensors pick it up; empty where there is none.

        It is looked for at 50 and 60 Hz and twice that, in experiments that nothing drives.
        """
        return self._parted[0]

    def without_hum(self) -> "Recording":
        """Return the recording without hum of the mains, a sine that is subtracted; the same where there is none.

        `improve` and the command line begin with it. An experiment is left as it is whose input may have made such a line, if that
        is larger or smaller than the hum.
        """
        found, experiments = self._parted
        return replace(self, experiments=experiments) if found else self

    def mended(self) -> "Recording":
        """Return the recording whose samples that are no measurement are missing.

        These are what stays at the end of a sensor's range, one and the same value as when a sensor or logger drops out, and spikes
        of up to three samples in a position or an angle; `rtac.concerns` names them. Keep spikes where parts of the rig hit each
        other there.
        """
        return replace(self, experiments=tuple(map(mended, self.experiments)))

    def current_noise(self) -> float:
        """Return the standard deviation of a measured current's noise, as experiments show it that nothing drives [A].

        Zero where the current is a command, or no such experiment was recorded. It shakes a model as a random torque would: each
        sample by `torque_constant` times as much.
        """
        return noise_level(current_noise(self.experiments))

    @cached_property
    def _parted(self) -> tuple[tuple[Hum, ...], tuple[Experiment, ...]]:
        return without_hum(self.experiments)

    @staticmethod
    def _every_fourth(moving: list[Experiment]) -> set[str]:
        held: set[str] = set()
        for kind in ("free", "forced"):
            originals = [e.name for e in moving if e.kind == kind and e.repeat_of is None]
            few = 1 < len(originals) < HOLD_OUT_EVERY
            held.update(originals[-1:] if few else originals[HOLD_OUT_EVERY - 1 :: HOLD_OUT_EVERY])
        return held

    def _known(self, names: Iterable[str], option: str) -> set[str]:
        # A single name is a sequence of letters, which would give a baffling message.
        wanted = {names} if isinstance(names, str) else set(names)
        for name in wanted:
            if name not in self.names:
                raise RecordingError(
                    f"/experiments/{name}: was named for {option}, but is not in the recording; choose among "
                    f"{', '.join(self.names)}."
                )
        return wanted


def _deviation(name: str, value: Any, rig: Mapping[str, float]) -> float:
    place = f"/rig/{name}{STD}"
    if name not in rig:
        raise RecordingError(
            f"{place}: there is no constant {name} beside it; give {name} too, or leave {name}{STD} out."
        )
    return positive(place, value, "the standard deviation")


def _check_repeat(experiment: Experiment, by_name: Mapping[str, Experiment]) -> None:
    if experiment.repeat_of is None:
        return
    place = f"/experiments/{experiment.name}: repeat_of is {experiment.repeat_of!r}"
    original = by_name.get(experiment.repeat_of)
    if original is None:
        raise RecordingError(f"{place}, which is not in the recording; add that experiment or leave repeat_of out.")
    if original.repeat_of is not None:
        raise RecordingError(f"{place}, itself a repeat; name the original, {original.repeat_of!r}.")
    for what in ("kind", "samples", "sample_time", "inputs"):
        if getattr(original, what) != getattr(experiment, what):
            raise RecordingError(f"{place}, but {what} differs between the two; leave repeat_of out.")


def _encodable(text: str) -> bool:
    # Half of a surrogate pair is a string to Python, but no text to a file.
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _is_lively(name: str, values: np.ndarray, place: int) -> bool:
    """Return whether the last part of an output of a decay, from a sample on, moves about as much as the whole of it.

    A position may have an offset; a speed has none, and that of a wheel that coasts is its motion though it hardly changes.
    """
    whole, end = values[np.isfinite(values)], values[place:][np.isfinite(values[place:])]
    size = (lambda part: np.sqrt(np.mean(part**2))) if name == "arm_velocity" else np.std
    return bool(end.size and size(end) > _LIVELY * size(whole))
