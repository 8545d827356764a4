"""Free simulations fitted with candidates added one after the other, from the fit that is diagnosed on."""

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from estimators.closed_form.fit import starting_values
from estimators.core.deadline import OutOfTimeError, require_time
from estimators.core.fit import Fit
from estimators.core.results import DivergedError, NotIdentifiableError
from estimators.diagnosis.gross_effects import placed_inside
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.refit import Refit
from estimators.diagnosis.refitting import beginning, from_simulation
from estimators.diagnosis.setting import Setting
from estimators.diagnosis.shared_structure import with_absent, without_absent
from estimators.diagnosis.workers import Workers
from estimators.inference.shaken_simulation import unfollowed
from estimators.misspecification.candidate_screening import Screened
from estimators.misspecification.detection_limit import largest_size
from estimators.misspecification.equation_screening import Explained
from estimators.output_error.fit import output_error
from rtac_jax import RTAC

_ATTENUATED = 3.0  # times as large as the equations of motion have it, which noise of the regressors makes smaller
# Of its size, with which an effect is begun where the simulation diverges with all of it: a spring that softens lets the cart go.
_PART = 0.3
_STEPS = 10  # of the optimiser in each stage: candidates are ranked, and the step after goes on from where one ended


class SimulatedFits:
    """The fits by simulation of a diagnosis: of the base model, and of models with candidates added.

    Attributes:
        errors: rms over the noise by channel, by number of the model before and id of the candidate; empty where none is fitted.
    """

    def __init__(self, fit: Fit, workers: Workers) -> None:
        """Begin with the fit that is diagnosed; `workers` compute side by side."""
        self.errors: dict[tuple[int, str], Mapping[str, float]] = {}
        self._base, self._workers = fit, workers
        self._with: dict[tuple[int, str], Fit | None] = {}
        self._of: dict[int, Fit] = {}

    def extend(self, number: int, setting: Setting, refit: Refit, several: Sequence[Screened | Explained]) -> None:
        """Fit a simulation with each of several candidates beside a model, by its number and its predictor."""
        fit = self._of.get(number, self._base)
        asked = [s for s in several if (number, s.id) not in self._with]
        for s, found in zip(
            asked, self._workers.each(lambda s: _simulated_with(setting, fit, refit, s), asked), strict=True
        ):
            self._with[number, s.id] = found
            self.errors[number, s.id] = {} if found is None else found.residual_over_noise

    def with_one(self, number: int) -> dict[str, Fit]:
        """Return the fits with one candidate beside a model, by its number, as far as there are any, by id of the candidate."""
        return {effect: fit for (before, effect), fit in self._with.items() if before == number and fit is not None}

    def finish(self, number: int, effect: str, setting: Setting) -> Fit | None:
        """Fit the simulation with a candidate to its end, by number of the model before and id; None where none could be begun."""
        begun = self._with.get((number, effect))
        if begun is not None:
            with contextlib.suppress(ArithmeticError, np.linalg.LinAlgError, NotIdentifiableError, OutOfTimeError):
                require_time()
                done = output_error(begun.model, setting.recording, from_model=True, progress=False)
                begun = begun if done.lost else done
        return begun

    def predictor_from(self, fit: Fit, setting: Setting, before: Refit, s: Screened | Explained) -> Refit | None:
        """Return the predictor that is fitted from where a simulation with a candidate ended; None where it diverges there."""
        setting.progress.at(f"diagnose: refit with {s.id}")
        model, free, added = beginning(setting, before, s)
        with contextlib.suppress(ArithmeticError, np.linalg.LinAlgError, OutOfTimeError):
            return from_simulation(setting, before, added, model, free, fit)
        return None

    def keep(self, number: int, fit: Fit) -> None:
        """Keep a fit as that of a model, by its number: where simulations with further candidates begin."""
        self._of[number] = fit


def _simulated_with(setting: Setting, fit: Fit, before: Refit, s: Screened | Explained) -> Fit | None:
    """Fit a simulation with a candidate beside what a fit has.

    Returns:
        None where it diverges, leaves parameters free, or ends at a size of the effect that is not plausible.
    """
    setting.progress.at(f"diagnose: simulation with {s.id}")
    model, _, _ = beginning(setting, before, s)
    effect = next(effect for effect in model.effects if effect.id == s.id)
    # A lost fit is no place to begin: the setting has the model in closed form.
    begin = (setting.model if fit.lost else fit.model) + effect
    if isinstance(s, Explained):
        begin = placed_inside(begin, {name: value for name, value in s.values.items() if name in begin.free})
    begins = [begin]
    if unfollowed(fit, setting.data, setting.policy.simulation) > setting.policy.unfollowed:
        # Its parameters are those of another motion, from which no few steps lead back.
        begins.append(starting_values(begin, setting.recording))
    several = [found for one in begins if (found := _begun_at(one, s, setting)) is not None]
    return min(several, key=lambda found: found.statistics["cost"], default=None)


def _begun_at(begin: RTAC, s: Screened | Explained, setting: Setting) -> Fit | None:
    """Fit a simulation by a few steps from a model's values; None where that comes to nothing."""
    with contextlib.suppress(ArithmeticError, np.linalg.LinAlgError, NotIdentifiableError, OutOfTimeError):
        require_time()
        # Candidates are many, and each would be compiled by itself for a few steps.
        wider = with_absent(setting, begin) or begin
        options: dict[str, Any] = dict(from_model=True, steps=_STEPS, led=False, progress=False)
        try:
            found = output_error(wider, setting.recording, **options)
        except DivergedError:
            small = {f"{s.id}.{name}": _PART * float(np.asarray(begin[f"{s.id}.{name}"])) for name in s.amplitudes}
            found = output_error(wider.with_values(small), setting.recording, **options)
        found = without_absent(found, begin)
        sound = not found.lost and np.all(np.isfinite(list(found.residual_std.values())))
        return found if sound and _plausible(found, s, setting.policy) else None
    return None


def _plausible(fit: Fit, s: Screened | Explained, policy: DiagnosisPolicy) -> bool:
    """Return whether an effect is no larger than those that data are asked to show, or than the equations of motion have it.

    Plausible sizes are those of the paper's rig; a pendulum of a hundred times the inertia has as much more gravity.
    """
    known = dict(zip(s.amplitudes, np.abs(s.begin), strict=True)) if isinstance(s, Explained) else {}
    sizes = {f"{s.id}.{name}": largest_size(s.instance, name, policy.testable) for name in s.amplitudes}
    by_equations = max((known.get(name, 0.0) / sizes[f"{s.id}.{name}"] for name in s.amplitudes), default=0.0)
    largest = max(1.0, _ATTENUATED * by_equations)
    return all(abs(float(np.asarray(fit.model[name]))) <= largest * size for name, size in sizes.items())
