"""Arguments and options that several commands of `rtac` have."""

from pathlib import Path
from typing import Annotated

import typer

File = Annotated[Path, typer.Argument(help="Recording (HDF5).", metavar="FILE", show_default=False)]
Validation = Annotated[
    str | None,
    typer.Option(
        metavar="NAME,...",
        help="Experiments to hold out; by default every fourth of each kind.",
        show_default=False,
    ),
]
Effects = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.py",
        help="Effects of your own: every class of effects in this file is looked for beside the catalogue.",
        show_default=False,
    ),
]
Out = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Folder for report.html and the figures.", show_default=False)
]
Model = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.h5",
        help="Begin with a saved model, fit or improvement (its last model) instead of the paper's model.",
        show_default=False,
    ),
]
Save = Annotated[
    Path | None,
    typer.Option(metavar="FILE.h5", help="Keep the result, for est.load and --model.", show_default=False),
]
Quick = Annotated[
    bool, typer.Option("--quick", help="Do not look again, for minutes, where the verdict would be unknown.")
]
Json = Annotated[Path | None, typer.Option(metavar="FILE", help="Write the result as JSON.", show_default=False)]
