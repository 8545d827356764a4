"""Results of a study: bias, scatter and coverage of every estimator, how often effects are named, and why repetitions failed."""

import collections
import csv
import dataclasses
import io
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from estimators.reporting.html import Shown, Table, versions, write_bytes, write_figures, write_report
from estimators.study.labelled import Labelled, dataset
from estimators.study.layout import REPETITION, Arrays, Layout
from estimators.study.naming import outcome
from estimators.study.spec import StudySpec

_LEVEL = 0.95


@dataclasses.dataclass(frozen=True, eq=False)
class StudyResults:
    """What the repetitions of a study came to.

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

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> "StudyResults":
        """Return what is finished of the study in a folder.

        Raises:
            StorageError: the folder holds no study, or a damaged file.
        """
        from estimators.study.repetition import layout_of
        from estimators.study.storage import Storage, description_in

        text = description_in(folder)
        spec = StudySpec.from_toml(text)
        layout = layout_of(spec)
        index, arrays = Storage(folder, spec.digest, layout).read(below=spec.repetitions)
        return cls(spec, index, layout, arrays)

    def __getitem__(self, variable: str) -> Labelled:
        """One variable with the names of its axes: "truth", "estimate", "std", "reason", ...

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
        """All variables, as an `xarray.Dataset` where xarray is installed, else as a dictionary of `Labelled`."""
        return dataset({name: self[name] for name in self.arrays})

    def select(self, *, hidden: str | None = None, excitation: str | None = None) -> "StudyResults":
        """Return the repetitions in which this was hidden or played."""
        kept = np.ones(len(self.index), dtype=bool)
        for variable, wanted in (("hidden", hidden), ("excitation", excitation)):
            if wanted is not None:
                kept &= self.arrays[variable] == wanted
        return dataclasses.replace(
            self, index=self.index[kept], arrays={name: values[kept] for name, values in self.arrays.items()}
        )

    @property
    def estimators(self) -> tuple[str, ...]:
        """Names of what was done with the data."""
        return self.layout.coordinates["estimator"]

    @property
    def failure_rate(self) -> Labelled:
        """Fraction of the repetitions that failed, by estimator."""
        failed = self.arrays["reason"] != ""
        return self._by_estimator(failed.mean(axis=0) if len(self.index) else np.full(len(self.estimators), np.nan))

    @property
    def failures(self) -> dict[str, dict[str, int]]:
        """How often each estimator failed for each reason, the most frequent first."""
        return {
            name: dict(collections.Counter(r for r in self.arrays["reason"][:, n] if r).most_common())
            for n, name in enumerate(self.estimators)
        }

    def summary(self, level: float = _LEVEL) -> dict[str, Labelled]:
        """Statistics over the repetitions, each by estimator and parameter.

        Args:
            level: of the intervals whose coverage is counted [1].

        Returns:
            `truth`: mean; `bias`: mean error; `bias_std`: its standard deviation; `std`: found, over the repetitions, of the error;
            `rms_error`; `stated_std`: root mean square of the stated ones; `coverage` of the stated intervals, with
            `coverage_low` and `coverage_high` of Clopper and Pearson at the same level; `consistency`: mean of the paper's measure;
            `count` of repetitions that have an estimate. NaN where there is none, or it was not kept.
        """
        axes = ("estimator", "parameter")
        shape = tuple(len(self.layout.coordinates[axis]) for axis in axes)
        nothing = np.full((len(self.index), *shape), np.nan)
        estimate, std, freedom, consistency = (
            self.arrays.get(name, nothing) for name in ("estimate", "std", "freedom", "consistency")
        )
        truth = np.broadcast_to(self.arrays["truth"][:, None, :], nothing.shape)
        error = estimate - truth
        known = np.isfinite(error)
        count = known.sum(axis=0)
        mean = _mean(error, known)
        scatter = np.sqrt(_mean((error - mean) ** 2, known) * count / np.where(count > 1, count - 1, np.nan))
        judged = known & np.isfinite(std) & (freedom > 0)
        reach = scipy.stats.t.ppf(0.5 + 0.5 * level, np.where(judged, freedom, 1.0)) * std
        inside = np.sum(judged & (np.abs(error) <= np.where(judged, reach, 0.0)), axis=0)
        trials = judged.sum(axis=0)
        low, high = clopper_pearson(inside, trials, level)
        with np.errstate(invalid="ignore"):
            found = {
                "truth": _mean(truth, known),
                "bias": mean,
                "bias_std": scatter / np.sqrt(np.where(count, count, np.nan)),
                "std": scatter,
                "rms_error": np.sqrt(_mean(error**2, known)),
                "stated_std": np.sqrt(_mean(std**2, judged)),
                "coverage": inside / np.where(trials, trials, np.nan),
                "coverage_low": low,
                "coverage_high": high,
                "consistency": _mean(consistency, np.isfinite(consistency)),
                "count": count.astype(float),
            }
        places = {axis: self.layout.coordinates[axis] for axis in axes}
        return {name: Labelled(values, axes, places) for name, values in found.items()}

    def quantities(self) -> dict[str, Labelled]:
        """Mean and standard deviation over the repetitions of what methods give besides parameters."""
        axes = ("estimator", "quantity")
        values = self.arrays.get("quantities")
        if values is None:
            return {}
        known = np.isfinite(values)
        mean = _mean(values, known)
        places = {axis: self.layout.coordinates[axis] for axis in axes}
        spread = np.sqrt(_mean((values - mean) ** 2, known))
        return {"mean": Labelled(mean, axes, places), "std": Labelled(spread, axes, places)}

    def envelope_coverage(self, estimator: str | None = None, level: float = _LEVEL) -> dict[str, float]:
        """How often an envelope holds what it states: the fraction of new conditions inside beside the stated probability.

        Returns:
            `stated`: mean probability; `inside`: mean fraction of new conditions; `kept`: fraction of envelopes of which at
            least the stated fraction of new conditions lies inside, with `kept_low` and `kept_high`; `confidence`: what it should
            reach.

        Raises:
            ValueError: the study made no envelopes.
        """
        names = [one.name for one in self.spec.estimate if one.method == "envelope"]
        if not names or "quantities" not in self.arrays:
            raise ValueError("this study kept no envelopes.")
        column = self["quantities"].sel(estimator=estimator or names[0])
        stated, inside, confidence = (column.sel(quantity=q).values for q in ("stated", "inside", "confidence"))
        known = np.isfinite(inside)
        kept = np.sum(inside[known] >= stated[known])
        low, high = clopper_pearson(np.asarray(kept), np.asarray(known.sum()), level)
        if not known.any():
            raise ValueError("no envelope was made: every repetition failed.")
        return {
            "stated": float(np.mean(stated[known])), "inside": float(np.mean(inside[known])),
            "kept": float(kept / known.sum()), "kept_low": float(low), "kept_high": float(high),
            "confidence": float(np.mean(confidence[known])),
        }  # fmt: skip

    def naming(self, estimator: str | None = None) -> Table:
        """Return what diagnoses named, beside what was hidden; one row for each hidden effect and excitation.

        Raises:
            ValueError: the study made no diagnosis.
        """
        column = self._diagnosis(estimator)
        rows = []
        words = ("right", "right and more", "in the group", "a part", "unknown", "adequate", "wrong", "failed")
        for excitation in dict.fromkeys(self.arrays["excitation"]):
            for hidden in dict.fromkeys(self.arrays["hidden"]):
                here = np.flatnonzero((self.arrays["hidden"] == hidden) & (self.arrays["excitation"] == excitation))
                if not len(here):
                    continue
                counts = collections.Counter(self._outcome(row, column) for row in here)
                wrong = {str(self.arrays["named"][r, column]) for r in here if self._outcome(r, column) == "wrong"}
                cells = [str(counts[word]) if counts[word] else "" for word in words]
                rows.append((str(hidden), str(excitation), *cells, "; ".join(sorted(wrong))))
        return Table(("hidden", "excitation", *words, "named instead"), tuple(rows), "Numbers of repetitions.")

    def confusion(self, estimator: str | None = None) -> tuple[tuple[str, ...], tuple[str, ...], np.ndarray]:
        """Hidden effects, what was named, and the fraction of repetitions with each pair.

        Of effects that the data cannot tell apart the hidden one counts as named; what names nothing counts by its verdict.

        Raises:
            ValueError: the study made no diagnosis.
        """
        column = self._diagnosis(estimator)
        hidden = tuple(dict.fromkeys(str(h) for h in self.arrays["hidden"]))
        counts: dict[tuple[str, str], float] = collections.defaultdict(float)
        for row, true in enumerate(self.arrays["hidden"]):
            for name in self._named(row, column):
                counts[str(true), name] += 1.0
        others = sorted({name for _, name in counts} - set(hidden) - {"adequate", "unknown", "failed"})
        last = [word for word in ("adequate", "unknown", "failed") if any(name == word for _, name in counts)]
        named = (*(h for h in hidden if h != "nothing"), *others, *last)
        totals = collections.Counter(str(h) for h in self.arrays["hidden"])
        return hidden, named, np.array([[counts[h, n] / totals[h] for n in named] for h in hidden])

    def _diagnosis(self, estimator: str | None) -> int:
        names = [one.name for one in self.spec.estimate if one.method == "diagnosis"]
        if not names:
            raise ValueError("this study made no diagnosis.")
        return self.estimators.index(estimator or names[0])

    def _outcome(self, row: Any, column: int) -> str:
        if self.arrays["reason"][row, column]:
            return "failed"
        return outcome(
            str(self.arrays["hidden"][row]),
            str(self.arrays["verdict"][row, column]),
            str(self.arrays["named"][row, column]),
        )

    def _named(self, row: int, column: int) -> list[str]:
        if self.arrays["reason"][row, column]:
            return ["failed"]
        text = str(self.arrays["named"][row, column])
        if not text:
            return [str(self.arrays["verdict"][row, column])]
        true = str(self.arrays["hidden"][row]).split(" + ")
        groups = [group.split("|") for group in text.split(" + ")]
        return [next((name for name in group if name in true), group[0]) for group in groups]

    def _by_estimator(self, values: np.ndarray) -> Labelled:
        return Labelled(values, ("estimator",), {"estimator": self.estimators})

    # -- what is shown -------------------------------------------------------------------------------------------------

    @property
    def has_estimates(self) -> bool:
        """Whether any parameter was estimated."""
        return bool(np.any(np.isfinite(self.arrays.get("estimate", np.zeros(0)))))

    def table(self) -> Table:
        """Bias, scatter and coverage by estimator and parameter, in percent of the true value."""
        found = self.summary()
        rows = []
        for e, estimator in enumerate(self.estimators):
            for p, parameter in enumerate(self.layout.coordinates["parameter"]):
                at = {name: float(one.values[e, p]) for name, one in found.items()}
                if not at["count"]:
                    continue
                size = abs(at["truth"]) or 1.0
                covered = (
                    f"{100 * at['coverage']:.1f} ({100 * at['coverage_low']:.1f} to {100 * at['coverage_high']:.1f})"
                    if np.isfinite(at["coverage"])
                    else ""
                )
                numbers = (
                    f"{100 * at[n] / size:.3g}" if np.isfinite(at[n]) else ""
                    for n in ("bias", "std", "rms_error", "stated_std")
                )
                consistency = f"{100 * at['consistency']:.1f}" if np.isfinite(at["consistency"]) else ""
                rows.append((estimator, parameter, f"{at['truth']:.4g}", *numbers, covered, consistency))
        header = ("estimator", "parameter", "truth", "bias [%]", "std found [%]", "rms error [%]", "std stated [%]",
                  "95 % intervals cover [%]", "consistency [%]")  # fmt: skip
        return Table(
            header,
            tuple(rows),
            "Coverage with its own 95 % interval; consistency: scatter over experiments, as Table 1.",
        )

    def failure_table(self) -> Table:
        """Why repetitions failed."""
        rows = [(name, str(count), reason) for name, each in self.failures.items() for reason, count in each.items()]
        return Table(("estimator", "repetitions", "reason"), tuple(rows))

    def quantity_table(self) -> Table:
        """Mean and scatter of what methods give besides parameters."""
        found = self.quantities()
        rows = []
        if found:
            mean, std = found["mean"].values, found["std"].values
            for e, q in np.argwhere(np.isfinite(mean)):
                names = self.estimators[e], self.layout.coordinates["quantity"][q]
                rows.append((*names, f"{mean[e, q]:.4g}", f"{std[e, q]:.2g}"))
        return Table(("estimator", "quantity", "mean", "std"), tuple(rows))

    @property
    def ending(self) -> str:
        """How much of the study is finished, and how often it failed."""
        failed = ", ".join(f"{name} failed in {sum(each.values())}" for name, each in self.failures.items() if each)
        return f"{len(self.index)} of {self.spec.repetitions} repetitions; {failed or 'none failed'}."

    def said(self) -> list[str]:
        """Return what the study found, in sentences."""
        said = [self.ending]
        if any(one.method == "envelope" for one in self.spec.estimate) and len(self.index):
            try:
                c = self.envelope_coverage()
            except ValueError as error:
                return [*said, str(error)]
            said.append(
                f"An envelope states that with {100 * c['confidence']:.0f} % confidence a new condition lies inside with a "
                f"probability of at least {100 * c['stated']:.1f} % on average; of new conditions {100 * c['inside']:.1f} % do. "
                f"The stated fraction lay inside {100 * c['kept']:.1f} % of the envelopes (95 % interval "
                f"{100 * c['kept_low']:.1f} to {100 * c['kept_high']:.1f} %)."
            )
        return said

    def __str__(self) -> str:
        blocks: list[Any] = [f"{self.spec.name}: {self.spec.question}".removesuffix(": "), *self.said()]
        if self.has_estimates:
            blocks.append(self.table())
        if any(one.method == "diagnosis" for one in self.spec.estimate) and len(self.index):
            blocks.append(self.naming())
        blocks += [table for table in (self.quantity_table(), self.failure_table()) if table.rows]
        return "\n\n".join(str(block) for block in blocks)

    def plot(self, which: str | None = None) -> Any:
        """One picture: "estimates", "coverage", "pairs", "confusion" or "envelopes"; by default the first that suits the study.

        Raises:
            ValueError: the study has no such picture.
        """
        known = self._pictures()
        if not known or (which is not None and which not in known):
            raise ValueError(f"there is no picture {which!r} of this study; there are {', '.join(known) or 'none'}.")
        draw, _ = known[which or next(iter(known))]
        return draw(self)

    def figures(self) -> dict[str, tuple[Any, str]]:
        """Every picture that suits the study, with a caption."""
        return {name: (draw(self), caption) for name, (draw, caption) in self._pictures().items()}

    def _pictures(self) -> dict[str, tuple[Callable[..., Any], str]]:
        from estimators.plots.study import plot_confusions, plot_coverage, plot_envelopes, plot_estimates, plot_pairs

        methods = {one.method for one in self.spec.estimate}
        suits = {
            "estimates": self.has_estimates,
            "coverage": bool(np.any(np.isfinite(self.summary()["coverage"].values))),
            "pairs": self.has_estimates,
            "confusion": "diagnosis" in methods and len(self.index) > 0,
            "envelopes": "quantities" in self.arrays
            and "envelope" in methods
            and bool(np.any(np.isfinite(self.arrays["quantities"]))),
        }
        pictures: dict[str, tuple[Callable[..., Any], str]] = {
            "estimates": (
                plot_estimates,
                "Error of every estimate in percent of the truth: bars are the repetitions, the line is the normal density with "
                "the stated standard deviation.",
            ),
            "coverage": (
                plot_coverage,
                "How often the stated 95 % interval holds the truth, with the 95 % interval of Clopper and Pearson.",
            ),
            "pairs": (
                plot_pairs,
                "Errors of two estimates of one repetition against each other, by the last estimator.",
            ),
            "confusion": (
                plot_confusions,
                "Rows: what was hidden. Columns: what was named; of a group that the data cannot tell apart the hidden "
                "effect counts.",
            ),
            "envelopes": (plot_envelopes, "Each point is one envelope; above the line it holds what it states."),
        }
        return {name: picture for name, picture in pictures.items() if suits[name]}

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the summary: one row for each estimator and parameter."""
        found = self.summary()
        rows: list[list[Any]] = [["estimator", "parameter", *found]]
        for e, estimator in enumerate(self.estimators):
            for p, parameter in enumerate(self.layout.coordinates["parameter"]):
                if found["count"].values[e, p]:
                    rows.append([estimator, parameter, *(float(one.values[e, p]) for one in found.values())])
        _write_csv(path, rows)

    def repetitions_to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write every repetition: one row for each of its estimators, failed ones with their reasons."""
        columns: list[tuple[str, Mapping[str, Any]]] = []
        names = self.layout.coordinates
        header = ["repetition", "hidden", "excitation", "estimator", "verdict", "named", "reason"]
        for variable in ("truth", "estimate", "std", "quantities"):
            if variable in self.arrays:
                axis = "quantity" if variable == "quantities" else "parameter"
                columns.append((variable, dict(enumerate(names[axis]))))  # type: ignore[arg-type] - keys are places
                header += [name if axis == "quantity" else f"{variable} of {name}" for name in names[axis]]
        rows: list[list[Any]] = [header]
        for r, index in enumerate(self.index):
            for e, estimator in enumerate(self.estimators):
                row = [int(index), self.arrays["hidden"][r], self.arrays["excitation"][r], estimator]
                row += [self.arrays[name][r, e] for name in ("verdict", "named", "reason")]
                for variable, _ in columns:
                    row += [
                        float(x)
                        for x in (self.arrays[variable][r] if variable == "truth" else self.arrays[variable][r, e])
                    ]
                rows.append(row)
        _write_csv(path, rows)

    def report(self, folder: str | os.PathLike[str]) -> Path:
        """Write figures, CSV files and a report of one HTML file into a folder; gives the report's path."""
        place = Path(folder)
        place.mkdir(parents=True, exist_ok=True)
        figures = self.figures() if len(self.index) else {}
        images = write_figures(place, {name: figure for name, (figure, _) in figures.items()})
        if self.has_estimates:
            self.to_csv(place / "summary.csv")
        self.repetitions_to_csv(place / "repetitions.csv")
        tables = [self.table()] if self.has_estimates else []
        if "confusion" in figures:
            tables.append(self.naming())
        tables += [table for table in (self.quantity_table(), self.failure_table()) if table.rows]
        settings = Table(("setting", "value"), (("study", self.spec.name), ("hash", self.spec.digest)))
        sections: list[Any] = [
            ("Result", [part for part in (self.spec.question, *self.said()) if part]),
            ("Figures", [Shown(figure, caption) for figure, caption in figures.values()]),
            ("Tables", tables),
            ("The study", [*(line for line in self.spec.to_toml().splitlines() if line)]),
            ("Settings and versions", [settings, versions()]),
        ]
        write_report(place / "report.html", f"Study: {self.spec.name}", sections, images=images)
        return place / "report.html"


def clopper_pearson(inside: np.ndarray, trials: np.ndarray, level: float = _LEVEL) -> tuple[np.ndarray, np.ndarray]:
    """Confidence interval of a probability from how often something happened; NaN without trials.

    Source: Clopper and Pearson, Biometrika 26 (1934).
    """
    tail = 0.5 * (1 - level)
    with np.errstate(invalid="ignore"):
        low = np.where(inside > 0, scipy.stats.beta.ppf(tail, np.maximum(inside, 1), trials - inside + 1), 0.0)
        high = np.where(
            inside < trials, scipy.stats.beta.ppf(1 - tail, inside + 1, np.maximum(trials - inside, 1)), 1.0
        )
    return np.where(trials > 0, low, np.nan), np.where(trials > 0, high, np.nan)


def _mean(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Over the repetitions where it is known; NaN where it never is."""
    count = known.sum(axis=0)
    return np.where(known, values, 0.0).sum(axis=0) / np.where(count, count, np.nan)


def _write_csv(path: str | os.PathLike[str], rows: list[list[Any]]) -> None:
    made = io.StringIO()
    csv.writer(made, lineterminator="\n").writerows(rows)
    write_bytes(path, made.getvalue().encode())
