"""The layout of what a repetition keeps: arrays whose axes have names, the first of them the repetition."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

Arrays = dict[str, np.ndarray]
REPETITION = "repetition"


@dataclasses.dataclass(frozen=True)
class Layout:
    """Names of the axes of every variable, and what stands along them.

    Attributes:
        numbers: variables of double precision, each with its axes after the repetition.
        texts: variables that hold text, likewise.
        coordinates: of each axis but the repetition.
    """

    numbers: Mapping[str, tuple[str, ...]]
    texts: Mapping[str, tuple[str, ...]]
    coordinates: Mapping[str, tuple[str, ...]]

    @property
    def variables(self) -> dict[str, tuple[str, ...]]:
        """Axes of all variables."""
        return {**self.numbers, **self.texts}

    def shape(self, variable: str, repetitions: int) -> tuple[int, ...]:
        """Shape of a variable with this many repetitions."""
        return (repetitions, *(len(self.coordinates[axis]) for axis in self.variables[variable]))

    def empty(self, repetitions: int) -> Arrays:
        """Arrays to be filled: numbers are NaN, texts are empty."""
        found: Arrays = {name: np.full(self.shape(name, repetitions), np.nan) for name in self.numbers}
        return found | {name: np.full(self.shape(name, repetitions), "", dtype=object) for name in self.texts}

    def table(self) -> dict[str, Any]:
        """Return the layout as plain dictionaries, which JSON can hold."""
        return {
            "numbers": {name: list(axes) for name, axes in self.numbers.items()},
            "texts": {name: list(axes) for name, axes in self.texts.items()},
            "coordinates": {name: list(values) for name, values in self.coordinates.items()},
        }
