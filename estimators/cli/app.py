"""`rtac`: what a recording says of a rig, from the command line.

Exit status 0: done; 1: the data do not allow it; 2: wrong use or unreadable file; 130: interrupted; 143: asked to stop.
"""

from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from estimators.cli.compare import compare
from estimators.cli.control import control
from estimators.cli.demo import demo
from estimators.cli.design import design
from estimators.cli.diagnose import diagnose
from estimators.cli.envelope import envelope
from estimators.cli.fit import fit
from estimators.cli.importing import import_files
from estimators.cli.improve import improve
from estimators.cli.info import info
from estimators.cli.next_experiment import next_experiment
from estimators.cli.refusals import show_tracebacks
from estimators.cli.study import study
from estimators.cli.warm_up import warm_up


class _Group(TyperGroup):
    """Takes `--debug` anywhere on the line."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        asked = "--debug" in args
        return super().parse_args(ctx, ["--debug"] * asked + [a for a in args if a != "--debug"])


app = typer.Typer(
    cls=_Group,
    help="Find the physics that a model of a rotational/translational actuator leaves out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Run a command; `rtac_entry.main` calls it when signals and pipes are taken care of."""
    app()


def _print_version(wanted: bool) -> bool:
    if wanted:
        from rtac_jax import __version__

        typer.echo(f"rtac-jax {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and leave.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show where in the code what goes wrong goes wrong.")] = False,
) -> None:
    """Take the options that stand before a command."""
    show_tracebacks(debug)


app.command()(demo)
app.command("import")(import_files)
for _command in (info, fit, compare, diagnose, improve, next_experiment, design, envelope, control, warm_up):
    app.command()(_command)
app.add_typer(study, name="study")

if __name__ == "__main__":
    main()
