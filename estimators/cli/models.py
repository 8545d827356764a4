"""Saved models on the command line: what a file holds, and whether its fit can be used as it stands."""

import difflib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from estimators.cli.doubts import explaining
from estimators.cli.job import Job
from estimators.cli.own_effects import offered, own_classes
from estimators.cli.refusals import WRONG_USE, stop

if TYPE_CHECKING:
    from estimators.core.fit import Fit
    from estimators.prediction_error.fit import PredictorFit
    from rtac_jax import RTAC
    from rtac_jax.measurement import Recording


def with_article(name: str) -> str:
    """Return a name with "a" or "an" before it."""
    return f"{'an' if name[0] in 'AEIOU' else 'a'} {name}"


def loaded(path: Path, effects: Path | None = None, option: str = "--model") -> Any:
    """Return what a file of results holds.

    Args:
        path: of the file.
        effects: Python file with the user's own effects that it may hold.
        option: that named the file, for a refusal.
    """
    import estimators as est

    try:
        return est.load(path, effects=own_classes(effects))
    except (est.ResultFileError, OSError) as error:
        stop(WRONG_USE, f"{option}: {error}")


def model_or_fit(path: Path, effects: Path | None = None) -> Any:
    """Return the model or the fit that a file holds; of an improvement the last fit, or the model by predictions beside it."""
    import estimators as est
    from rtac_jax import RTAC

    found = loaded(path, effects)
    if isinstance(found, est.Improvement):
        return found.final if found.by_predictions is None else found.by_predictions.model
    if isinstance(found, est.Fit | RTAC):
        return found
    if isinstance(found, est.PredictorFit | est.ClosedForm):
        return found.model
    stop(
        WRONG_USE, f"--model: {path} holds {with_article(type(found).__name__)}; give a model, a fit or an improvement."
    )


def recommended_fit(path: Path, effects: Path | None = None) -> Any:
    """Return the model or the fit that a file holds, as it is; of an improvement the fit by predictions, or the last one."""
    import estimators as est

    found = loaded(path, effects)
    if isinstance(found, est.Improvement) and found.by_predictions is not None:
        return found.by_predictions
    return found if isinstance(found, est.PredictorFit) else model_or_fit(path, effects)


def start_model(
    work: Job, path: Path | None, effects: Path | None = None, fix: str | None = None, add: str | None = None
) -> Any:
    """Return the model to begin with: that of a file, or the paper's with the constants of the recording.

    Args:
        work: the job.
        path: of the file.
        effects: Python file with the user's own effects that it may hold.
        fix: parameters that are not estimated, NAME or NAME=VALUE, with commas between.
        add: effects that it has besides, with commas between.
    """
    model = work.model() if path is None else _model_of(model_or_fit(path, effects))
    return _held(_extended(work, model, effects, add or ""), fix or "")


def _extended(work: Job, model: "RTAC", effects: Path | None, add: str) -> Any:
    """Return a model with the effects that `--add` names, each of a plausible size and of the middle one of its shapes."""
    from estimators.core.initial_state import scales_of
    from rtac_jax.effects import CATALOGUE

    known = {effect.id: effect for effect in offered(effects) or CATALOGUE.values()}
    for name in filter(None, (text.strip() for text in add.split(","))):
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            meant = f"did you mean {near[0]}?" if near else f"give one of {', '.join(known)}."
            stop(WRONG_USE, f"--add {name}: there is no such effect; {meant}")
        if name in model:
            stop(WRONG_USE, f"--add {name}: the model has it already; leave that out.")
        several = known[name].candidates(scales_of(model, _moving(work.train)))
        model = model + several[len(several) // 2]
    return model


def _held(model: "RTAC", fix: str) -> Any:
    """Return a model with the parameters fixed that `--fix` names, at the values that it gives."""
    for one in filter(None, (text.strip() for text in fix.split(","))):
        name, _, value = (text.strip() for text in one.partition("="))
        try:
            model = model.fix(name)
        except ValueError as error:
            stop(WRONG_USE, f"--fix {one}: {error}")
        if value:
            low, high = model.parameters[name].bounds
            number = _number(value)
            if not low <= number <= high:
                unit = model.parameters[name].unit
                stop(WRONG_USE, f"--fix {one}: give a number from {low:g} to {high:g} {unit} after the equals sign.")
            model = model.with_values({name: number})
    return model


def base_fit(work: Job, path: Path | None, effects: Path | None = None) -> Any:
    """Return the fit to begin with: that of a file where it is of the same data, else a fit of its model to these."""
    if path is None:
        return work.fitted(work.model())
    import estimators as est

    found = model_or_fit(path, effects)
    if isinstance(found, est.Fit) and fitted_to(found, work.train):
        work.note(f"The fit is that of {path.name}.")
        return found
    work.note(f"The model of {path.name} was fitted to this recording, from its values on.")
    with explaining(work.recording, work.doubts or []):
        return est.output_error(_model_of(found), work.train, from_model=True)


def any_fit(work: Job, path: Path | None, effects: Path | None = None) -> Any:
    """Return the fit of a file, whatever it was made of; a model is fitted to this recording, and so is the paper's without one."""
    if path is None or not hasattr(found := model_or_fit(path, effects), "information"):
        return base_fit(work, path, effects)
    work.note(f"The model is that of {path.name}, fitted to {len(found.experiments)} experiments.")
    return found


def fitted_to(fit: "Fit | PredictorFit", recording: "Recording") -> bool:
    """Return whether a fit was made of the moving experiments of a recording, and of no others."""
    names = [e.name for e in _moving(recording)]
    return set(names) == set(fit.experiments) == set(seen(fit, recording))


def seen(fit: "RTAC | Fit | PredictorFit", recording: "Recording") -> list[str]:
    """Return the names of the experiments in a recording that a fit was made of; none for a model."""
    import estimators as est
    from estimators.core.data import is_among, mark_of, moving, pieces

    if isinstance(fit, est.PredictorFit):  # which knows them by name only
        return [e.name for e in pieces(moving(recording)) if e.name in fit.experiments]
    marks = getattr(fit, "marks", {})
    several = pieces([e for e in moving(recording) if is_among(e, marks)])
    return [e.name for e in several if marks.get(e.name) == mark_of(e)]


def _moving(recording: "Recording") -> Any:
    """Return what a fit takes of a recording."""
    from estimators.core.data import moving, pieces

    return pieces(moving(recording))


def _number(text: str) -> float:
    """Return a number, NaN where the text is none."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _model_of(found: "RTAC | Fit | PredictorFit") -> Any:
    return getattr(found, "model", found)
