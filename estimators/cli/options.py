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
Json = Annotated[Path | None, typer.Option(metavar="FILE", help="Write the result as JSON.", show_default=False)]
