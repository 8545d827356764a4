"""Tables of a model's parameters, for a terminal and for a notebook."""

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np

from rtac_jax.overview import Overview
from rtac_jax.parameters import Declaration


@runtime_checkable
class Parameters(Protocol):
    """The rows of a model's table."""

    @property
    def ids(self) -> tuple[str, ...]:
        """Return the ids of the effects."""
        ...

    @property
    def parameters(self) -> Mapping[str, Declaration]:
        """Return every parameter's declaration by name."""
        ...

    @property
    def free(self) -> tuple[str, ...]:
        """Return the names of the parameters that a fit estimates."""
        ...

    def __getitem__(self, name: str) -> Any: ...


def overview_of(model: Parameters) -> Overview:
    """Return every parameter with its value, and whether it is estimated."""
    rows = [
        (name, declared.symbol, _shown(np.asarray(model[name])), declared.unit, "" if name in model.free else "fixed")
        for name, declared in model.parameters.items()
    ]
    title = f"rigid body with {', '.join(model.ids)}" if model.ids else "rigid body without any effect"
    return Overview(title, ("parameter", "symbol", "value", "unit", ""), rows)


def table_of(model: Parameters) -> str:
    """Return a table of parameters with symbol, value, unit and meaning, one a line."""
    rows = []
    for name, declared in model.parameters.items():
        shown = _shown(np.asarray(model[name]))
        note = "" if name in model.free else "  (fixed)"
        rows.append(f"{name:32s} {declared.symbol:10s} {shown:>12s} {declared.unit:10s} {declared.meaning}{note}")
    return "\n".join(rows)


def _shown(value: np.ndarray) -> str:
    return f"{float(value):.6g}" if value.ndim == 0 else f"{value.size} values"
