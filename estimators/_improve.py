"""The loop: compare, diagnose, add the effect, fit again, until nothing rejects or the held-out error stops falling."""

import dataclasses
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from estimators._compare import Comparison, compare
from estimators._diagnose import Candidate, Diagnosis, Verdict, compile_diagnosis, diagnose
from estimators._output_error import Fit, output_error
from estimators._results import DivergedError, NotIdentifiableError
from rtac_jax import RTAC
from rtac_jax.effects import CATALOGUE, Effect
from rtac_jax.measurement import Recording

_CLEAR = 0.05  # share by which the held-out error has to fall where an effect gets a second chance


@dataclasses.dataclass(frozen=True)
class Improvement:
    """Result of `improve`.

    Attributes:
        fits: of the base model and of every model after it, in order.
        diagnoses: one for every fit that was diagnosed.
        added: the effects that were added, in order, as the diagnosis saw them.
        verdict: "adequate" if nothing was missing, "missing" if what was added makes the model adequate or all that can be
            named, else what the last diagnosis says.
        train, validation: every model against the experiments that it was fitted to, and against those held out.
        held: ids of added effects that are held at the estimate of the diagnosis, because a fit by simulation fails, or serves
            held-out experiments worse; deviations of the other parameters are for that value of theirs.
        stopped: why the loop ended.
        seconds: how long it took.
    """

    fits: tuple[Fit, ...]
    diagnoses: tuple[Diagnosis, ...]
    added: tuple[Candidate, ...]
    verdict: Verdict
    train: Comparison
    validation: Comparison
    held: tuple[str, ...]
    stopped: str
    seconds: float

    @property
    def base(self) -> Fit:
        """The fit without any effect added."""
        return self.fits[0]

    @property
    def final(self) -> Fit:
        """The fit with all effects added."""
        return self.fits[-1]

    @property
    def ending(self) -> str:
        """What was held, if anything, and why the loop ended."""
        if not self.held:
            return self.stopped
        return (
            f"Held at the estimate of the diagnosis, because a fit by simulation fails or serves held-out experiments worse: "
            f"{', '.join(self.held)}. {self.stopped}"
        )

    def __str__(self) -> str:
        lines = []
        for diagnosis in self.diagnoses:
            lines.append(diagnosis.explanation)
        lines.append(self.ending)
        for title, comparison in (("train", self.train), ("validation", self.validation)):
            for model in comparison.models:
                errors = ", ".join(
                    f"{channel} {e.rms:.3g} ({e.rms_over_noise:.2f} times the noise)"
                    for channel, e in model.errors.items()
                )
                lines.append(f"{title:10s} {model.label:24s} {errors}")
        return "\n".join(lines)

    def plot(self) -> Any:
        """Error before and after, as a matplotlib figure."""
        from estimators.plots import plot_improvement

        return plot_improvement(self)


def improve(
    model: RTAC,
    recording: Recording,
    *,
    validation: Sequence[str] | None = None,
    candidates: Sequence[type[Effect]] | None = None,
    most: int = 4,
    progress: bool = True,
) -> Improvement:
    """Fit, diagnose, add what is missing, fit again, and validate on experiments that no fit has seen.

    An effect is kept if the error of the held-out experiments falls in the channels together. Where it does not, or where the
    effect cannot be fitted by simulation, as on a rig that random forces shake, the effect is held at the estimate of the
    diagnosis, which foresees one sample at a time, and kept if the error falls so by a twentieth. The held-out experiments
    choose the models by that, so their last error is a little too good.

    Args:
        validation: names of the experiments to hold out; by default every fourth of each kind.
        candidates: classes of effects to try; by default the whole catalogue.
        most: effects to add at most.
        progress: show bars.

    Raises:
        ValueError: there is nothing to hold out, or nothing moves.
        NotIdentifiableError, DivergedError: as `output_error`, for the base model.
    """
    began = time.perf_counter()
    train, held_out = recording.split(validation)
    with ThreadPoolExecutor(1) as other:
        other.submit(compile_diagnosis, model, train, candidates)
        fits = [output_error(model, train, progress=progress)]
        tested = [compare(fits[0], held_out, labels=["base"]).models[0]]
    diagnoses: list[Diagnosis] = []
    added: list[Candidate] = []
    held: list[str] = []
    stopped = ""
    while not stopped:
        # What is held was estimated too: a diagnosis may move it.
        released = fits[-1].model.release(*_parameters(fits[-1].model, held))
        found = diagnose(dataclasses.replace(fits[-1], model=released), train, candidates=candidates, progress=progress)
        diagnoses.append(found)
        if not found.additions:
            enough = found.verdict == "adequate"
            stopped = f"Stopped: {'nothing more is missing' if enough else 'what is missing is not in the catalogue'}."
        known = {c.id: c for c in found.effects}
        for effect in found.additions:
            if len(added) == most:
                stopped = f"Stopped: {most} effects were added; more seem to be missing."
                break
            label = "+ " + ", ".join([*(c.id for c in added), effect.id])
            reasons = []
            extended = fits[-1].model + effect
            for tried in (extended, holding(extended, [effect.id])):
                try:
                    better = output_error(tried, train, from_model=True, progress=progress)
                    test = compare(better, held_out, labels=[label]).models[0]
                except (NotIdentifiableError, DivergedError, FloatingPointError) as error:
                    reasons.append(f"Stopped: with {effect.id} the model could not be fitted: {error}")
                    continue
                if _misfit(test) <= (1 - _CLEAR * bool(reasons)) * _misfit(tested[-1]):
                    break
                reasons.append(f"Stopped: with {effect.id} the held-out error would not fall.")
            else:
                stopped = f"{reasons[0]} Held at the estimate of the diagnosis, it would not help clearly either."
                break
            if reasons:
                held.append(effect.id)
            fits.append(better)
            tested.append(test)
            added.append(known[effect.id])
        if not stopped and not [c for c in (candidates or CATALOGUE.values()) if c.id not in fits[-1].model]:
            stopped = "Stopped: every candidate was added."
    labels = [model.label for model in tested]
    last = diagnoses[-1].verdict
    verdict: Verdict = "unknown" if last in ("missing", "ambiguous") else last
    if added:
        verdict = "ambiguous" if any(c.confusable_with for c in added) else "missing"
    return Improvement(
        fits=tuple(fits),
        diagnoses=tuple(diagnoses),
        added=tuple(added),
        verdict=verdict,
        train=compare(fits, train, labels=labels),
        validation=Comparison(tuple(tested)),
        held=tuple(held),
        stopped=stopped,
        seconds=time.perf_counter() - began,
    )


def holding(model: RTAC, effects: Sequence[str]) -> RTAC:
    """The model with all parameters of these effects, by id, held at their values."""
    return model.fix(*_parameters(model, effects))


def _parameters(model: RTAC, effects: Sequence[str]) -> list[str]:
    return [name for name in model.parameters if name.split(".")[0] in effects]


def _misfit(compared: Any) -> float:
    """Mean over the channels of the error in units of the noise, where no channel can hide another."""
    errors = [e.rms_over_noise for e in compared.errors.values()]
    return sum(errors) / len(errors)
