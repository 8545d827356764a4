"""The columns of a foreign file: which channel each is, and in which unit, as the user and the file say."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from estimators.cli.refusals import WRONG_USE, stop

if TYPE_CHECKING:
    from rtac_jax.measurement import Experiment

MAT = ".mat"
_TIME = "time"
_DELIMITERS = {";": '";"', "\t": "$'\\t'", ",": '","'}  # and how a shell is given them


@dataclasses.dataclass(frozen=True)
class Columns:
    """The columns of one file as they were understood: names and units by channel, and the channels that it does not have.

    Of `unstated` channels nobody says the unit, of `named` ones the name of the column does.
    """

    file: Path
    channels: Mapping[str, str]
    units: Mapping[str, str]
    time: str | None
    text: bool
    left_out: tuple[str, ...] = ()
    unstated: tuple[str, ...] = ()
    named: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        file: Path,
        asked: Mapping[str, str],
        time: str | None,
        sample_time: float | None,
        delimiter: str,
        scale: Mapping[str, float],
        elsewhere: set[str],
    ) -> "Columns":
        """Find column and unit of every channel in a file; a channel whose column only other files have is left out."""
        from rtac_jax.measurement import (
            FACTORS,
            INPUTS,
            OUTPUTS,
            csv_header,
            ending_unit,
            name_and_unit,
            usual_spelling,
        )

        known = {**INPUTS, **OUTPUTS, _TIME: "s"}
        text = file.suffix.lower() != MAT
        header = csv_header(file, delimiter) if text else []
        other = next((mark for mark in _DELIMITERS if len(header) == 1 and mark in header[0]), None)
        if other is not None:
            stop(
                WRONG_USE,
                f"{file}: the row that should name its columns has one, {header[0]!r}; give --delimiter {_DELIMITERS[other]}.",
            )
        there = f"; the columns of {file.name} are {', '.join(header)}" if header else ""
        if not asked:
            stop(WRONG_USE, f'--channel: say which column is which, as in --channel cart_position="x [mm]"{there}.')
        if (time is None) == (sample_time is None):
            stop(WRONG_USE, f"--time, --sample-time: give one of the two{there}.")
        channels, units, unstated, named = {}, {}, [], []
        for channel, wish in {**asked, **({} if time is None else {_TIME: time})}.items():
            if channel not in known:
                stop(WRONG_USE, f"--channel: there is no channel {channel}; use {', '.join([*INPUTS, *OUTPUTS])}.")
            column, unit = name_and_unit(wish)
            channels[channel] = column
            if header and column not in header:
                # Often the file states the unit in its first row, and so need not the user.
                stated = [
                    (cell, says) for cell in header for name, says in [name_and_unit(cell)] if cell != name == column
                ]
                if len(stated) > 1:
                    cells = ", ".join(cell for cell, _ in stated)
                    stop(
                        WRONG_USE, f"{file}: has {len(stated)} columns named {column!r} ({cells}); rename all but one."
                    )
                if not stated:
                    if channel != _TIME and column in elsewhere:
                        del channels[channel]
                        continue
                    stop(
                        WRONG_USE,
                        f"{file}: has no column {column!r} for {channel}{there.replace(f' of {file.name}', '')}.",
                    )
                channels[channel], says = stated[0]
                if unit and usual_spelling(unit) != usual_spelling(says):
                    stop(
                        WRONG_USE,
                        f"{file}: says that {column} is in {says}, and --channel {channel} says {unit}; correct one.",
                    )
                unit = says
            if not unit and channel not in scale:
                unit = ending_unit(channels[channel], known[channel])
                (named if unit else unstated).append(channel)
            unit = unit or known[channel]
            units[channel] = usual_spelling(unit)
            if channel not in scale and units[channel] not in FACTORS[known[channel]]:
                stop(
                    WRONG_USE,
                    f"--channel {channel}: the unit {unit!r} is not known for it, only {', '.join(FACTORS[known[channel]])}; "
                    f"give --scale {channel}=FACTOR, in {known[channel]} per {unit}.",
                )
        column_of_time = channels.pop(_TIME, None)
        left_out = tuple(channel for channel in asked if channel not in channels)
        return cls(
            file,
            channels,
            {c: u for c, u in units.items() if c not in scale},
            column_of_time,
            text,
            left_out,
            tuple(unstated),
            tuple(named),
        )

    def only_here(self, wanted: Mapping[str, Any]) -> dict[str, Any]:
        """Return the options of a reader without what they say of channels that this file does not have."""
        found = dict(wanted)
        for key in ("scale", "noise_std", "remove_mean"):
            kept = [name for name in wanted[key] if name not in self.left_out]
            found[key] = {n: wanted[key][n] for n in kept} if isinstance(wanted[key], dict) else kept
        return found

    def table(self, experiment: "Experiment", scale: Mapping[str, float]) -> str:
        """Return what was understood: column, unit, factor and range of every channel."""
        import numpy as np

        from estimators.reporting.html import Table
        from rtac_jax.measurement import FACTORS, foreign_unit

        rows = []
        for channel, column in self.channels.items():
            signal = {**experiment.inputs, **experiment.outputs}[channel]
            factor = scale[channel] if channel in scale else FACTORS[signal.unit][self.units[channel]]
            low, high = np.nanmin(signal.values), np.nanmax(signal.values)
            unit = "of its own" if channel in scale else self.units[channel]
            rows.append((column, unit, f"{factor:.6g}", channel, signal.unit, f"{low:.4g}", f"{high:.4g}"))
        clock = f"times in {self.time!r} [{self.units.get(_TIME, 's')}]" if self.time else "the sample time given"
        head = (
            f"{self.file}: {experiment.kind} experiment {experiment.name}, {experiment.samples} samples of "
            f"{experiment.sample_time:.6g} s, from {clock}."
        )
        if self.left_out:
            head += f" It has no column for {', '.join(self.left_out)}."
        if self.named:
            head += f" By their columns' names: {self._in_units(self.named)}; state another as in 'n [rpm]'."
        if self.unstated:
            taken = self._in_units(self.unstated)
            head += f" No unit is stated of these: {taken} by assumption; state one as in 'n [rpm]'."
        for channel in (c for c in self.unstated if c != _TIME):
            column, unit = self.channels[channel], self.units[channel]
            if said := foreign_unit(column):
                head += (
                    f" {column!r} ends in {said}, which is no unit of {channel}: it is read as {unit}, and so is what depends on"
                    f" it; give --scale {channel}=FACTOR, in {unit} per {said}."
                )
        return f"{head}\n{Table(('column', 'unit', 'times', 'is', 'in', 'from', 'to'), tuple(rows))}"

    def _in_units(self, channels: Sequence[str]) -> str:
        return ", ".join(f"{self.time if c == _TIME else self.channels[c]} in {self.units[c]}" for c in channels)


def names_in(file: Path, delimiter: str) -> set[str]:
    """Return the names of the columns of a text file, with the units that they state and without."""
    from rtac_jax.measurement import csv_header, name_and_unit

    names = csv_header(file, delimiter)
    return {*names, *(name_and_unit(name)[0] for name in names)}
