"""Results of a study: bias, scatter and coverage of every estimator, how often effects are named, and why repetitions failed."""

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np

from estimators.reporting.html import Table
from estimators.study import confusion, files, pictures, statistics, tables
from estimators.study.kept import Kept
from estimators.study.labelled import Labelled
from estimators.study.spec import SpecError, StudySpec


@dataclasses.dataclass(frozen=True, eq=False)
class StudyResults(Kept):
    """The results of a study's repetitions."""

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> "StudyResults":
        """Return what is finished of the study in a folder.

        Raises:
            StorageError: the folder holds no study, or a damaged file.
            SpecError: its description is damaged.
        """
        from estimators.study.repetition import layout_of
        from estimators.study.storage import Storage, description_in

        text = description_in(folder)
        try:
            spec = StudySpec.from_toml(text)
        except SpecError as error:
            raise SpecError(f"{Path(folder) / 'study.toml'}: {error}") from None
        layout = layout_of(spec)
        index, arrays = Storage(folder, spec.digest, layout).read(below=spec.repetitions)
        return cls(spec, index, layout, arrays)

    def select(self, *, hidden: str | None = None, excitation: str | None = None) -> "StudyResults":
        """Return the repetitions in which this was hidden or played."""
        kept = np.ones(len(self.index), dtype=bool)
        for variable, wanted in (("hidden", hidden), ("excitation", excitation)):
            if wanted is not None:
                kept &= self.arrays[variable] == wanted
        return dataclasses.replace(
            self, index=self.index[kept], arrays={name: values[kept] for name, values in self.arrays.items()}
        )

    def summary(self, level: float = statistics.LEVEL) -> dict[str, Labelled]:
        """Statistics over the repetitions, each by estimator and parameter.

        Args:
            level: of the intervals whose coverage is counted [1].

        Returns:
            `truth`: mean; `bias`: mean error; `bias_std`: its standard deviation; `std`: found, over the repetitions, of the error;
            `rms_error`; `stated_std`: root mean square of the stated ones; `coverage` of the stated intervals, with
            `coverage_low` and `coverage_high` of Clopper and Pearson at the same level; `consistency`: mean of the paper's measure;
            `count` of repetitions that have an estimate. NaN where there is none, or it was not kept.
        """
        return statistics.summary(self, level)

    def quantities(self) -> dict[str, Labelled]:
        """Mean and standard deviation over the repetitions of what methods give besides parameters."""
        return statistics.quantities(self)

    def envelope_coverage(self, estimator: str | None = None, level: float = statistics.LEVEL) -> dict[str, float]:
        """Return how often an envelope holds what it states: the fraction of new conditions inside beside the stated probability.

        Returns:
            `stated`: mean probability; `inside`: mean fraction of new conditions; `kept`: fraction of envelopes of which at
            least the stated fraction of new conditions lies inside, with `kept_low` and `kept_high`; `confidence`: what it should
            reach.

        Raises:
            ValueError: the study made no envelopes.
        """
        return statistics.envelope_coverage(self, estimator, level)

    def naming(self, estimator: str | None = None) -> Table:
        """Return what diagnoses named, beside what was hidden; one row for each hidden effect and excitation.

        Raises:
            ValueError: the study made no diagnosis.
        """
        return confusion.naming(self, estimator)

    def confusion(self, estimator: str | None = None) -> tuple[tuple[str, ...], tuple[str, ...], np.ndarray]:
        """Hidden effects, what was named, and the fraction of repetitions with each pair.

        Of effects that the data cannot tell apart the hidden one counts as named; what names nothing counts by its verdict.

        Raises:
            ValueError: the study made no diagnosis.
        """
        return confusion.fractions(self, estimator)

    def table(self, of: tables.Subject = "parameters") -> Table:
        """Return a table of parameters, of the other quantities that methods give, or of failures and their reasons.

        Args:
            of: "parameters": bias, scatter and coverage by estimator, in percent of the true value; "quantities": mean and scatter;
                "failures": how many repetitions of each estimator failed, by reason.
        """
        return tables.table(self, of)

    @property
    def ending(self) -> str:
        """Return how much of the study is finished, and how often it failed."""
        return tables.ending(self)

    def said(self) -> list[str]:
        """Return what the study found, in sentences."""
        return tables.said(self)

    def __str__(self) -> str:
        return tables.text(self)

    def plot(self, which: str | None = None) -> Any:
        """Return a picture: "estimates", "coverage", "pairs", "bode", "confusion" or "envelopes".

        Raises:
            ValueError: the study has no such picture.
        """
        return pictures.plot(self, which)

    def figures(self) -> dict[str, tuple[Any, str]]:
        """Return every picture that suits the study, with a caption."""
        return pictures.figures(self)

    def to_csv(self, path: str | os.PathLike[str], *, repetitions: bool = False) -> None:
        """Write the summary, one row for each estimator and parameter, or every repetition.

        Args:
            path: of the file.
            repetitions: one row for each estimator of each repetition instead, failed ones with their reasons.
        """
        return files.repetitions_to_csv(self, path) if repetitions else files.to_csv(self, path)

    def report(self, folder: str | os.PathLike[str]) -> Path:
        """Write figures, CSV files and a report of one HTML file into a folder; gives the report's path."""
        return files.report(self, folder)
