"""How long who waits at a terminal gives a diagnosis."""

from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from rtac_jax.measurement import Recording

# Minutes of a diagnosis for 10^5 samples of the longest experiment: 5 for the 24,800 of a drive that dry friction held.
_DIAGNOSIS = 20.0
_WITHIN = 400.0  # s that a diagnosis, or a loop, is given by default: who waits at a terminal wants an answer
_LONGER = 4.0  # of what is foretold for long experiments, where that is more


def time_for(recording: "Recording", within: float | None) -> float | None:
    """Return the seconds that a diagnosis is given, None for no end; say on the screen how long it takes of long experiments.

    Args:
        recording: that is diagnosed.
        within: that were asked for, 0 for no end; None for the default.
    """
    from estimators.core.piecewise_triangle import LONG

    longest, foretold = max(e.samples for e in recording), 0.0
    if longest >= LONG:
        minutes = _DIAGNOSIS * longest / 1e5
        foretold = 60 * minutes
        typer.echo(
            f"rtac: an experiment of {longest:,} samples: a diagnosis of it takes some {minutes:.0f} minutes, and more where "
            "effects are added; a part of it is answered sooner (Experiment.cut, or --end of rtac import).",
            err=True,
        )
    given = max(_WITHIN, _LONGER * foretold) if within is None else within
    return given or None
