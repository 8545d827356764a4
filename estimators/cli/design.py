"""`rtac design`: currents that a rig can play, for the responses of its operating conditions."""

from pathlib import Path
from typing import Annotated

import typer

from estimators.cli.job import prepare, say
from estimators.cli.limits import TorqueLimit, Travel, numbers, positive
from estimators.cli.models import model_or_fit
from estimators.cli.options import Effects, Model
from estimators.cli.output_files import writable_file
from estimators.cli.refusals import WRONG_USE, answering, stop

_ENDINGS = (".h5", ".hdf5")


def design(
    out: Annotated[
        Path, typer.Argument(metavar="OUT.h5", help="Recording of the currents, to be played.", show_default=False)
    ],
    model: Model = None,
    band: Annotated[str, typer.Option(metavar="LOW,HIGH", help="Of the multisine, in Hz.")] = "1,5",
    rms: Annotated[
        float, typer.Option(metavar="A", help="Of the largest current; lowered where a limit asks for it.")
    ] = 0.1,
    duration: Annotated[float, typer.Option(metavar="S", help="Of one experiment.")] = 20.0,
    sample_time: Annotated[float, typer.Option(metavar="S")] = 0.01,
    angles: Annotated[
        str, typer.Option(metavar="RAD,...", help="Of the arm at the start, one experiment for each.")
    ] = "0,0.3,-0.3,3.1416",
    amplitudes: Annotated[
        str, typer.Option(metavar="F,...", help="Fractions of the largest safe current, for each angle or in turn.")
    ] = "1",
    travel: Travel = 15.0,
    torque_limit: TorqueLimit = 0.1,
    seed: Annotated[int, typer.Option(help="Of the phases of the multisines.")] = 0,
    replace: Annotated[
        bool, typer.Option("--replace", help="Write over a recording of measurements, if one is there.")
    ] = False,
    csv: Annotated[bool, typer.Option("--csv", help="Write every experiment as a CSV file beside it, too.")] = False,
    effects: Effects = None,
) -> None:
    """Design currents within a rig's limits of torque and travel, by simulation of a model: one multisine for each angle."""
    sizes_asked = {"--rms": rms, "--duration": duration, "--sample-time": sample_time}
    positive({**sizes_asked, "--travel": travel, "--torque-limit": torque_limit})
    starts, sizes, edges = numbers("--angles", angles), numbers("--amplitudes", amplitudes), numbers("--band", band)
    if len(edges) != 2 or not 0 < edges[0] < edges[1] < 0.5 / sample_time:
        stop(
            WRONG_USE,
            f"--band is {band!r}; give two frequencies in Hz below half of the sampling rate, {0.5 / sample_time:g} Hz, as 1,5.",
        )
    if out.suffix.lower() not in _ENDINGS:
        stop(WRONG_USE, f"{out}: cannot be written; let the name end in {' or '.join(_ENDINGS)}.")
    with answering():
        writable_file(out, "the recording", replace=replace)
        prepare()
        import numpy as np

        import rtac_jax as rtac
        from rtac_jax.measurement import from_rest, multisine

        found = rtac.RTAC.paper() if model is None else model_or_fit(model, effects)
        physics = getattr(found, "model", found)
        count = round(duration / sample_time)
        waves = [
            from_rest(
                multisine(samples=count, sample_time=sample_time, rms=rms, band=(edges[0], edges[1]), seed=seed + n)
            )
            for n in range(len(starts))
        ]
        designed = rtac.design_excitation(
            physics, np.stack(waves), sample_time=sample_time, initial_angles=starts, amplitudes=sizes, travel=1e-3 * travel,
            torque_limit=torque_limit,
        )  # fmt: skip
        designed.save(out)
        written = [out]
        for experiment in designed if csv else ():
            written.append(out.with_name(f"{out.stem}_{experiment.name}.csv"))
            designed.select([experiment.name]).save(written[-1])
        whose = (
            "Model: the paper's; give your own fit with --model." if model is None else f"Model: that of {model.name}."
        )
        say(whose, designed, f"written: {', '.join(map(str, written))}")
