"""`rtac import`: from the files of a data logger to one recording."""

import dataclasses
from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from estimators.cli.columns import MAT, Columns, names_in
from estimators.cli.job import say
from estimators.cli.options import option
from estimators.cli.output_files import writable_file
from estimators.cli.refusals import WRONG_USE, answering, stop

if TYPE_CHECKING:
    from rtac_jax.measurement import Recording

_HDF5 = (".h5", ".hdf5")


Pairs = list[str] | None


def import_files(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE... OUT.h5",
            help="CSV or MAT-files, one experiment each, or recordings to add to; and the recording to write, last: one of these, "
            "or a new one.",
            show_default=False,
        ),
    ],
    channel: Annotated[
        Pairs,
        option(
            'NAME="COLUMN [UNIT]"',
            "The column of a channel and its unit; without a unit, the one in its name, else that of the recording.",
        ),
    ] = None,
    kind: Annotated[
        Pairs,
        option("free|forced|rest", "One for all files, or one for each in their order, or by names, 'run_*=forced'."),
    ] = None,
    time: Annotated[str | None, option('"COLUMN [UNIT]"', "The column of the times; s, ms or us.")] = None,
    sample_time: Annotated[float | None, option("SECONDS", "Instead of a column of times.")] = None,
    name: Annotated[
        Pairs,
        # Named here: typer 0.27 takes the word in the help for the option's name where the two are one word.
        option("NAME", "Of the experiments, one for each file; by default the files' names.", "--name"),
    ] = None,
    angle: Annotated[
        list[float] | None,
        option("RAD", "Arm angle at the start, one for all files, or one for each in which the rig moves."),
    ] = None,
    angle_std: Annotated[
        float | None, option("RAD", "Standard deviation of every angle given; 0.1 rad without it.")
    ] = None,
    repeat_of: Annotated[
        Pairs, option("NAME=OTHER", "An experiment that plays another one once more, from the same start.")
    ] = None,
    scale: Annotated[
        Pairs,
        option("NAME=FACTOR", "Recording's unit per unit of the column, for a unit that is not known, such as volts."),
    ] = None,
    rig: Annotated[
        Pairs, option("NAME=VALUE", "A constant known beforehand, SI units, such as total_mass=1.23.")
    ] = None,
    noise: Annotated[Pairs, option("NAME=STD", "Standard deviation of a sensor's noise, SI units.")] = None,
    remove_mean: Annotated[
        Pairs, option("NAME", "A channel that loses its mean, as that of a sensor with an offset.")
    ] = None,
    unwrap: Annotated[
        bool,
        typer.Option(
            "--unwrap", help="Take jumps of whole turns out of arm_angle, as of an encoder that begins again."
        ),
    ] = False,
    mend: Annotated[
        bool,
        typer.Option(
            "--mend",
            help="Drop rows that a logger wrote twice, put those that it lost back as missing samples, and make clipped samples,"
            " dropouts and spikes missing.",
        ),
    ] = False,
    resample: Annotated[
        float | None, option("SECONDS", "Bring rows at uneven times to samples so far apart, by straight lines.")
    ] = None,
    intersample: Annotated[
        Pairs, option("NAME=zoh|foh|bl", "What an input does between samples; held (zoh) by default.")
    ] = None,
    arm: Annotated[str, typer.Option(metavar="free|locked", help="Whether the arm could turn.")] = "free",
    cart: Annotated[str, typer.Option(metavar="free|clamped", help="Whether the cart could move.")] = "free",
    start: Annotated[int, typer.Option(help="First sample to take, of every file.")] = 0,
    end: Annotated[int | None, option("SAMPLE", "The sample after the last to take.")] = None,
    delimiter: Annotated[str, typer.Option(help="Between the columns of a CSV file: a character, or tab.")] = ",",
    replace: Annotated[bool, typer.Option("--replace", help="Write over a recording that is there already.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what was understood, and write nothing.")] = False,
) -> None:
    """Import CSV and MAT-files into one recording, with units converted, and show what was understood.

    Known units: A, mA, uA; N, mN, kN; m, cm, mm, um, in; rad/s, mrad/s, deg/s, rev/s, rpm; rad, mrad, deg, rev; s, ms, us.
    """
    with answering():
        *sources, out = files
        if out.suffix.lower() not in _HDF5 or not sources:
            stop(WRONG_USE, f"{out}: name the files to import and then the recording to write, which ends in .h5.")
        foreign = [file for file in sources if file.suffix.lower() not in _HDF5]
        for file in sources:
            if not file.is_file():
                stop(WRONG_USE, f"{file}: there is no such file{', but a folder' * file.is_dir()}; check the path.")
        if not dry_run:
            added_to = out.exists() and any(out.samefile(file) for file in sources)
            writable_file(out, "the recording", replace=replace or added_to)
        count = len(foreign)
        kinds = _kinds(kind, foreign)
        names = _for_each("--name", name, count, one_for_all=count == 1)
        angles = _angles(angle, kinds)
        wanted = {
            "scale": {n: _number("--scale", n, v) for n, v in _pairs("--scale", scale).items()},
            "noise_std": {n: _number("--noise", n, v) for n, v in _pairs("--noise", noise).items()},
            "intersample": _pairs("--intersample", intersample),
            "remove_mean": remove_mean or (), "unwrap": unwrap, "mend": mend, "resample": resample, "arm": arm, "cart": cart,
            "start": start, "stop": end,
            "rig": {n: _number("--rig", n, v) for n, v in _pairs("--rig", rig).items()},
        }  # fmt: skip
        asked = _pairs("--channel", channel)
        from rtac_jax import RTAC
        from rtac_jax.constants import require_constants
        from rtac_jax.measurement import Recording, concerns, describe

        understood, parts = [], []
        seen = {name for file in foreign if file.suffix.lower() != MAT for name in names_in(file, delimiter)}
        told = iter(zip(kinds, names, angles, strict=True))
        for file in sources:
            if file not in foreign:
                parts.append(Recording.load(file).mended() if mend else Recording.load(file))
                understood.append(
                    f"{file}: a recording; its experiments come along {'mended' if mend else 'as they are'}."
                )
                continue
            what, called, at = next(told)
            columns = Columns.of(file, asked, time, sample_time, delimiter, wanted["scale"], seen)
            options: dict[str, Any] = {"delimiter": delimiter} if columns.text else {}
            reader = Recording.from_csv if columns.text else Recording.from_mat
            part = reader(
                file, channels=columns.channels, units=columns.units, time=columns.time, sample_time=sample_time, kind=what,
                name=called, initial_arm_angle=at, initial_arm_angle_std=None if at is None else angle_std,
                **columns.only_here(wanted), **options,
            )  # fmt: skip
            parts.append(part)
            understood.append(columns.table(parts[-1].experiments[0], wanted["scale"]))
        recording = _with_repeats(Recording.join(*parts), _pairs("--repeat-of", repeat_of))
        try:
            require_constants(RTAC.paper(), recording.rig)
        except ValueError as error:
            stop(WRONG_USE, str(error))
        if not dry_run:
            recording.save(out)
        found = concerns(recording)
        doubts = "concerns: none" if not found else "\n".join(["concerns:", *(f"- {sentence}" for sentence in found)])
        say(
            *understood,
            describe(recording),
            doubts,
            f"{out}: not written, as --dry-run asks." if dry_run else f"written: {out}",
        )


def _pairs(option: str, given: Sequence[str] | None) -> dict[str, str]:
    """Return NAME=VALUE options as a dictionary."""
    found: dict[str, str] = {}
    for text in given or ():
        name, sign, value = (part.strip() for part in text.partition("="))
        if not (name and sign and value):
            stop(WRONG_USE, f"{option}: is {text!r}; write NAME=VALUE.")
        if name in found:
            stop(WRONG_USE, f"{option}: names {name} twice; give it once.")
        found[name] = value
    return found


def _number(option: str, name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        stop(WRONG_USE, f"{option} {name}: is {text!r}; give a number with a decimal point.")


def _with_repeats(recording: "Recording", repeats: Mapping[str, str]) -> "Recording":
    """Return the recording in which experiments name those that they repeat."""
    for name, other in repeats.items():
        for wanted in (name, other):
            if wanted not in recording.names:
                stop(WRONG_USE, f"--repeat-of: there is no experiment {wanted}; use {', '.join(recording.names)}.")
    said = [dataclasses.replace(e, repeat_of=repeats.get(e.name, e.repeat_of)) for e in recording.experiments]
    return dataclasses.replace(recording, experiments=tuple(said))


def _kinds(given: Sequence[str] | None, files: Sequence[Path]) -> list[Any]:
    """Return the kind of each file: one for all, one for each, or that of the first pattern that its name matches.

    A pattern that no file is left for is a mistake.
    """
    if not given or not all("=" in one for one in given):
        return _for_each("--kind", given, len(files), required=bool(files))
    patterns = [one.rpartition("=")[::2] for one in given]
    found, used = [], set()
    for file in files:
        kinds = [(p, what) for p, what in patterns if fnmatch(file.name, p) or fnmatch(file.stem, p)]
        if not kinds:
            stop(
                WRONG_USE,
                f"--kind: no pattern of {', '.join(given)} matches {file.name}; add one, as '{file.stem}=free'.",
            )
        pattern, what = kinds[0]
        used.add(pattern)
        found.append(what)
    if idle := [pattern for pattern, _ in patterns if pattern not in used]:
        stop(WRONG_USE, f"--kind: no file is left for {', '.join(idle)}; the first pattern that a name matches counts.")
    return found


def _angles(given: Sequence[float] | None, kinds: Sequence[str]) -> list[float | None]:
    """Return the angle for each file, None for one at rest where each of the others was given its own."""
    moving = [kind != "rest" for kind in kinds]
    if given and len(given) == sum(moving) < len(kinds) and len(given) > 1:
        angles = iter(given)
        return [next(angles) if moves else None for moves in moving]
    return _for_each("--angle", given, len(kinds))


def _for_each(
    option: str, given: Sequence[Any] | None, count: int, *, required: bool = False, one_for_all: bool = True
) -> list[Any]:
    """Return one value for each file, from one for all or one for each; None for each where none was given."""
    if not given:
        if required:
            stop(WRONG_USE, f"{option}: say what kind of experiment the files hold: free, forced or rest.")
        return [None] * count
    if len(given) == count:
        return list(given)
    if len(given) == 1 and one_for_all:
        return [given[0]] * count
    stop(
        WRONG_USE,
        f"{option}: was given {len(given)} times for {count} files; give it {'once, or ' if one_for_all else ''}once for each.",
    )
