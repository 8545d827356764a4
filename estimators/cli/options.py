"""Arguments and options that several commands of `rtac` have."""

from pathlib import Path
from typing import Annotated, Any

import typer


def option(metavar: str, help: str, *names: str) -> Any:
    """Declare an option that is nothing by default, so that no default is shown.

    Args:
        metavar: what stands for its value in the help.
        help: what it is for.
        names: of the option, with their dashes; by default made of the parameter's.
    """
    return typer.Option(*names, metavar=metavar, help=help, show_default=False)


File = Annotated[Path, typer.Argument(help="Recording (HDF5).", metavar="FILE", show_default=False)]
Validation = Annotated[
    str | None,
    option("NAME,...", "Experiments to hold out; by default every fourth of each kind."),
]
Effects = Annotated[
    Path | None,
    option("FILE.py", "Effects of your own: every class of effects in this file stands beside the catalogue."),
]
Out = Annotated[Path | None, option("DIR", "Folder for report.html and the figures.")]
Model = Annotated[
    Path | None,
    option("FILE.h5", "Begin with a saved model, fit or improvement (its last model) instead of the paper's model."),
]
Fix = Annotated[
    str | None,
    option(
        "NAME[=VALUE],...", "Parameters that are not estimated, at their value in the model or at this one (SI units)."
    ),
]
Add = Annotated[
    str | None,
    option("NAME,...", "Effects of the catalogue, or of --effects, that the model has from the beginning."),
]
Save = Annotated[
    Path | None,
    option(
        "FILE.h5",
        "Keep the result, for est.load; a fit or an improvement also for --model, a diagnosis for --diagnosis.",
    ),
]
Quick = Annotated[
    bool, typer.Option("--quick", help="Do not look again, for minutes, where the verdict would be unknown.")
]
Within = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        min=0.0,
        help="The answer is wanted after so long, beside the fit of the base model, and is what was found until then; 0 for no "
        "end. By default 400, or more where experiments are long.",
        show_default=False,
    ),
]
NoLearnedForce = Annotated[
    bool,
    typer.Option(
        "--no-learned-force",
        help="Add no last resort where the verdict is unknown: no likely effect, no learned force.",
    ),
]
Json = Annotated[Path | None, option("FILE", "Write the result as JSON.")]
