"""The common part of `rtac envelope` and `rtac control`: envelopes of the conditions in a recording."""

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from estimators.cli.job import Job
from estimators.cli.options import option
from estimators.cli.refusals import WRONG_USE, stop

if TYPE_CHECKING:
    from estimators.uncertainty.envelope import Envelope

_IMPORTANCE = (0.5, 1.0)  # powers of the responses' size by which P0 for `control` keeps closest where they are large
WeightOrder = Annotated[int, typer.Option(min=0, max=8, help="Poles and zeros of the uncertainty weight.")]
Band = Annotated[
    str | None,
    option("LOW,HIGH", "Band in Hz; by default where all currents have energy."),
]


def enveloped(
    work: Job,
    band: tuple[float, float] | None,
    orders: Sequence[int],
    weight_order: int,
    kind: str,
    minimise: str = "mean",
    *,
    modes: int | None = None,
    for_control: bool = False,
) -> tuple[Any, list[Any]]:
    """Return responses, and envelopes of each order; one that cannot be is left out as long as another can.

    For control the nominal model keeps closest to the responses where they are large, as limited torque does nothing
    elsewhere, a little or much; and unless they were named, none is held out: a held-out condition raises the weight at all
    frequencies alike, which costs more than what could then be said of new ones.
    """
    import numpy as np

    import estimators as est
    from estimators.uncertainty.condition_selection import usable_conditions

    used = usable_conditions(work.recording, band=band, modes=modes, progress=True)
    apart = set(work.held_out.names) if work.held_out is not None else set()
    held = [i for i, one in enumerate(used.responses) if one.name in apart]
    if work.names is None and (for_control or len(used.responses) - len(held) < 2):
        held = []  # of few conditions none can be spared
    fitted = [i for i in range(len(used.responses)) if i not in held]
    size = np.exp(np.mean(np.log(np.abs(used.responses.response[fitted])), axis=0))
    importances = [(size / np.max(size)) ** power for power in _IMPORTANCE] if for_control else [None]
    found, refusals = [], []
    for order, importance in itertools.product(orders, importances):
        try:
            one = est.envelope(
                used.responses, kind=kind, order_nominal=order, order_weight=weight_order, held_out=held,
                importance=importance, minimise=minimise,
            )  # fmt: skip
            found.append(one)
        except ValueError as error:
            refusals.append(error)
    if not found:
        raise refusals[0]
    return used, found


def sides(found: "Envelope") -> tuple[list[str], list[str]]:
    """Return the conditions that were fitted, and those held out."""
    pairs = list(zip(found.names, found.held_out, strict=True))
    return [name for name, held in pairs if not held], [name for name, held in pairs if held]


def band_of(text: str | None) -> tuple[float, float] | None:
    """Return the band that was asked for in Hz; None where none was."""
    if text is None:
        return None
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        low, high = 0.0, 0.0
    if not 0 < low < high < float("inf"):
        stop(WRONG_USE, f"--band is {text!r}; give two frequencies in Hz, such as 0.6,8.")
    return low, high
