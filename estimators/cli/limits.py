"""The limits of a rig, as options of the commands that plan what it does."""

from collections.abc import Mapping
from typing import Annotated

import typer

from estimators.cli.refusals import WRONG_USE, stop

Travel = Annotated[float, typer.Option(metavar="MM", help="Of the cart, to each side.")]
TorqueLimit = Annotated[float, typer.Option(metavar="NM", help="Of the motor, in N m.")]


def positive(options: Mapping[str, float]) -> None:
    """Refuse an option that is not a positive number."""
    for name, value in options.items():
        if not 0 < value < float("inf"):
            stop(WRONG_USE, f"{name} is {value:g}; give a positive number.")


def numbers(option: str, text: str) -> list[float]:
    """Return the numbers of an option, between commas."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        stop(WRONG_USE, f"{option} is {text!r}; give numbers between commas, such as 0,0.5.")
