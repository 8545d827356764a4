"""Effects that a user keeps in a Python file, for the command line."""

import importlib.util
import inspect
import sys
from pathlib import Path
from typing import Any

from estimators.cli.refusals import WRONG_USE, stop
from estimators.diagnosis.candidate_set import require_distinct
from rtac_jax.effects import CATALOGUE, Effect


def with_own(file: Path | None) -> list[type[Effect]] | None:
    """Return the catalogue and every class of effects that a Python file defines; None where there is no file.

    Raises:
        ValueError: the file cannot be run, defines none, or one that cannot be looked for.
    """
    if file is None:
        return None
    if not file.is_file():
        raise ValueError(f"{file}: there is no such file; give a Python file with a class on rtac_jax.effects.Force.")
    spec = importlib.util.spec_from_file_location(f"own_effects_{file.stem}", file)
    if spec is None or spec.loader is None:
        raise ValueError(f"{file}: is no Python file; give one that ends in .py.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look annotations up
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # whatever the user's own code may raise
        del sys.modules[spec.name]
        said = (str(error).strip().splitlines() or ["no reason given"])[0].rstrip(".")
        raise ValueError(
            f"{file}: cannot be run: {type(error).__name__}: {said}; mend it, or see the whole traceback with --debug."
        ) from error
    defined = dict.fromkeys(c for c in vars(module).values() if inspect.isclass(c) and c.__module__ == module.__name__)
    effects = [c for c in defined if issubclass(c, Effect) and not inspect.isabstract(c)]
    # What others build on and has no name of its own is no effect.
    own = [c for c in effects if hasattr(c, "id") or not any(issubclass(o, c) for o in effects if o is not c)]
    if not own:
        raise ValueError(f"{file}: defines no effect; write a class on rtac_jax.effects.Force or one of its kind.")
    return require_distinct([*CATALOGUE.values(), *own])


def own_classes(effects: Path | None) -> list[type[Effect]]:
    """Return the user's own effects that a Python file defines; none where there is no file."""
    known = set(CATALOGUE.values())
    return [effect for effect in offered(effects) or () if effect not in known]


def offered(effects: Path | None) -> Any:
    """Return the catalogue with the user's own effects; None for the catalogue alone."""
    try:
        return with_own(effects)
    except ValueError as error:
        stop(WRONG_USE, f"--effects: {error}")
