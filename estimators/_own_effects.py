"""Effects that a user keeps in a Python file, for the command line."""

import importlib.util
import inspect
from pathlib import Path

from rtac_jax.effects import CATALOGUE, Effect


def with_own(file: Path | None) -> list[type[Effect]] | None:
    """The catalogue and every class of effects that a Python file defines; None where there is no file.

    Raises:
        ValueError: the file cannot be run, or defines none.
    """
    if file is None:
        return None
    spec = importlib.util.spec_from_file_location(f"own_effects_{file.stem}", file)
    if spec is None or spec.loader is None:
        raise ValueError(f"{file}: is no Python file; give one that ends in .py.")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever the user's own code may raise
        raise ValueError(f"{file}: cannot be run: {type(error).__name__}: {error}") from error
    own = [
        c
        for _, c in inspect.getmembers(module, inspect.isclass)
        if issubclass(c, Effect) and c.__module__ == module.__name__ and not inspect.isabstract(c)
    ]
    if not own:
        raise ValueError(f"{file}: defines no effect; write a class on rtac_jax.effects.Force or one of its kind.")
    return [*CATALOGUE.values(), *own]
