"""The numbers that a study's repetitions kept: every variable, with the names of its axes."""

import collections
import dataclasses
from typing import Any

import numpy as np

from estimators.study.labelled import Labelled, dataset
from estimators.study.layout import REPETITION, Arrays, Layout
from estimators.study.spec import StudySpec


@dataclasses.dataclass(frozen=True, eq=False)
class Kept:
    """The kept numbers of a study.

    Attributes:
        spec: of the study.
        index: numbers of the repetitions that are finished.
        layout: of the variables.
        arrays: every variable, with the repetition as first axis.
    """

    spec: StudySpec
    index: np.ndarray
    layout: Layout
    arrays: Arrays

    def __getitem__(self, variable: str) -> Labelled:
        """Return one variable with the names of its axes: "truth", "estimate", "std", "reason", ...

        Raises:
            KeyError: there is none of that name, or it was not kept.
        """
        if variable not in self.arrays:
            raise KeyError(f"there is no variable {variable!r}; kept were {', '.join(self.arrays)}.")
        axes = (REPETITION, *self.layout.variables[variable])
        coordinates = {REPETITION: tuple(int(n) for n in self.index)}
        coordinates |= {axis: self.layout.coordinates[axis] for axis in axes[1:]}
        return Labelled(self.arrays[variable], axes, coordinates)

    @property
    def dataset(self) -> Any:
        """Return all variables, as an `xarray.Dataset` where xarray is installed, else as a dictionary of `Labelled`."""
        return dataset({name: self[name] for name in self.arrays})

    @property
    def estimators(self) -> tuple[str, ...]:
        """Return the names of what was done with the data."""
        return self.layout.coordinates["estimator"]

    @property
    def failure_rate(self) -> Labelled:
        """Fraction of the repetitions that failed, by estimator."""
        failed = self.arrays["reason"] != ""
        return self._by_estimator(failed.mean(axis=0) if len(self.index) else np.full(len(self.estimators), np.nan))

    @property
    def failures(self) -> dict[str, dict[str, int]]:
        """Return how often each estimator failed for each reason, the most frequent first."""
        return {
            name: dict(collections.Counter(r for r in self.arrays["reason"][:, n] if r).most_common())
            for n, name in enumerate(self.estimators)
        }

    @property
    def has_estimates(self) -> bool:
        """Return whether any parameter was estimated."""
        return bool(np.any(np.isfinite(self.arrays.get("estimate", np.zeros(0)))))

    def _by_estimator(self, values: np.ndarray) -> Labelled:
        return Labelled(values, ("estimator",), {"estimator": self.estimators})
