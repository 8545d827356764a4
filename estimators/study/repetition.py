"""Repetitions of a study: draw parameters, make data, estimate, and keep what was asked for."""

import dataclasses
from collections.abc import Mapping, Sequence

from estimators.study.chunk_size import per_chunk
from estimators.study.fit_chunk import QUANTITIES, fit_chunk, model_for, parameters_of
from estimators.study.layout import Arrays, Layout
from estimators.study.outcome import Outcome, Prepared
from estimators.study.recordings import recordings
from estimators.study.spec import StudySpec
from estimators.study.truth import Truth, true_for
from estimators.study.work import Work
from rtac_jax.programs.collection import collected_later


@dataclasses.dataclass(frozen=True)
class Repetitions(Work):
    """The work of a study, which any process can do a part of.

    Attributes:
        spec: of the study.
    """

    spec: StudySpec

    @property
    def name(self) -> str:
        """Return the name of the study."""
        return self.spec.name

    @property
    def count(self) -> int:
        """Return how many there are."""
        return self.spec.repetitions

    @property
    def digest(self) -> str:
        """Return what all numbers depend on."""
        return self.spec.digest

    @property
    def per_chunk(self) -> int:
        """Return how many one chunk has by default."""
        return per_chunk(self.spec)

    @property
    def layout(self) -> Layout:
        """Return what a repetition keeps."""
        return layout_of(self.spec)

    def compute(self, indices: Sequence[int]) -> Arrays:
        """Return the repetitions with these numbers; the bits of each depend on the study and its number alone."""
        spec, layout = self.spec, self.layout
        kept = layout.empty(len(indices))
        place = {axis: {name: n for n, name in enumerate(names)} for axis, names in layout.coordinates.items()}
        ready = _ready(spec, indices, kept, place["parameter"])
        for column, estimate in enumerate(spec.estimate):
            ended = fit_chunk(estimate, list(ready.values()), spec.model.start)
            for row, outcome in zip(ready, ended, strict=True):
                if isinstance(outcome, str):
                    kept["reason"][row, column] = outcome
                else:
                    _keep(outcome, kept, row, column, place)
        return kept


def _ready(spec: StudySpec, indices: Sequence[int], kept: Arrays, places: Mapping[str, int]) -> dict[int, Prepared]:
    """Return what is to be estimated from, by row, and keep truths and the reasons of what cannot be made."""
    ready: dict[int, Prepared] = {}
    with collected_later():
        truths = [_truth(spec, index) for index in indices]
        for row, (truth, recording) in enumerate(zip(truths, recordings(spec, indices, truths), strict=True)):
            if not isinstance(truth, str):
                kept["hidden"][row], kept["excitation"][row] = truth.hidden.effect, truth.excitation.name
                for name, column in places.items():
                    kept["truth"][row, column] = truth.values.get(name, float("nan"))
            if isinstance(recording, str) or isinstance(truth, str):
                kept["reason"][row, :] = str(recording)
                continue
            try:
                ready[row] = Prepared(model_for(spec, truth, recording), recording, truth)
            except (ValueError, ArithmeticError) as error:
                kept["reason"][row, :] = f"no model: {type(error).__name__}: {' '.join(str(error).split())}"
    return ready


def _truth(spec: StudySpec, index: int) -> Truth | str:
    try:
        return true_for(spec, index)
    except (ValueError, ArithmeticError) as error:
        return f"no truth: {type(error).__name__}: {' '.join(str(error).split())}"


def _keep(outcome: Outcome, kept: Arrays, row: int, column: int, place: dict[str, dict[str, int]]) -> None:
    kept["verdict"][row, column], kept["named"][row, column] = outcome.verdict, outcome.named
    for name, value in outcome.values.items():
        if name not in place["parameter"]:
            continue
        at = row, column, place["parameter"][name]
        for variable, number in (
            ("estimate", value.value), ("std", value.std), ("freedom", value.freedom), ("consistency", value.consistency),
        ):  # fmt: skip
            if variable in kept:
                kept[variable][at] = number
    if "quantities" in kept:
        for name, number in outcome.quantities.items():
            kept["quantities"][row, column, place["quantity"][name]] = number


def layout_of(spec: StudySpec) -> Layout:
    """Return what a repetition of this study keeps."""
    each = ("estimator", "parameter")
    chosen = {
        "estimate": {"estimate": each},
        "std": {"std": each, "freedom": each},
        "consistency": {"consistency": each},
        "quantities": {"quantities": ("estimator", "quantity")},
    }
    numbers: dict[str, tuple[str, ...]] = {"truth": ("parameter",)}
    for statistic in spec.keep:
        numbers |= chosen[statistic]
    quantities = dict.fromkeys(name for estimate in spec.estimate for name in QUANTITIES[estimate.method])
    return Layout(
        numbers,
        {
            "hidden": (),
            "excitation": (),
            "verdict": ("estimator",),
            "named": ("estimator",),
            "reason": ("estimator",),
        },
        {
            "estimator": tuple(estimate.name for estimate in spec.estimate),
            "parameter": parameters_of(spec),
            "quantity": tuple(quantities),
        },
    )
