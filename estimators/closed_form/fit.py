"""Closed form: equations (5) and (6) of the paper, by filtered differences or against test functions."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from estimators.closed_form.initial_angle import angle_told, with_initial_angles
from estimators.closed_form.modulating_functions import NEAR_WEAK, integrated_terms
from estimators.closed_form.regressors import Terms, automatic_cutoff, sampled_terms
from estimators.closed_form.table1 import ClosedForm, ClosedFormOptions
from estimators.closed_form.two_stage import Estimates, Weighting, forced_stage, free_stage
from estimators.closed_form.unknown_scale import SCALING, scale_stage, unknown_scales
from estimators.core.sensor_noise import noise_levels
from rtac_jax import RTAC
from rtac_jax.arguments import checked_arguments
from rtac_jax.effect_contract import require_working_model
from rtac_jax.measurement import Experiment, Recording, resolution

_TURNS = 4
_DRY = "cart_coulomb.level"
_NEAR = 0.05  # of the rms velocity, below which the sign of a filtered velocity is wrong
_FEW_COUNTS = 3.5  # of an encoder: one that flickers between two of them, or three, shows no motion
_LOST = "experiment {}: nobody measured where the arm begins, and it moves too little to show it."
_HELD = "experiment {}: dry friction holds the cart, whose encoder shows a count more or less."
AS_IN_PAPER: Mapping[str, Any] = {"weighting": "none", "near_zero": 0.0}
"""Options of `least_squares` that leave out what the paper does not write of: weights, and samples where the cart hardly moves."""


@checked_arguments
def least_squares(
    model: RTAC,
    recording: Recording,
    *,
    weak: bool = False,
    instruments: bool = False,
    reaction: bool | None = None,
    weighting: Weighting = "residual",
    cutoff: float | None = None,
    near_zero: float | None = None,
) -> ClosedForm:
    """Estimate the parameters in closed form: free oscillation first, then, with those known, forced oscillation.

    By default as the paper does it, on filtered and differentiated measurements, with choices of our own where it is silent:
    the filter's cut-off, the weights of the two equations, and leaving out samples where the cart hardly moves, without
    which v and d of a decay that ends at rest are off by a factor. `**AS_IN_PAPER` leaves the last two out. With `weak` both
    equations are integrated against test functions instead, which takes the errors of the regressors away.

    Args:
        model: gives the constants known beforehand (its fixed parameters, and those with a prior, which are held at their
            values here; standard deviations count the priors') and which parameters there are.
        recording: with free or forced experiments; those at rest give the noise levels only.
        weak: integrate against test functions instead of differentiating.
        instruments: with `weak`, take the arm's velocity from before a test function began as the instrument for its friction, so
            that random torques, which drive the motion that they disturb, do not bias it. From one experiment that is a
            quotient of two uncertain numbers, so prefer `pooled`.
        reaction: in free oscillation, count the arm's reaction instead of neglecting it as the paper does; by default only
            with `weak`.
        weighting: of the two equations of forced oscillation: "residual" for each by its own error, "inertia" for
            accelerations, dividing by M+m and I+me^2, "none" for forces and torques as they are.
        cutoff: of the ninth-order zero-phase Chebyshev filter [Hz]; by default where each spectrum sinks into the noise.
        near_zero: samples slower than this fraction of the rms velocity are left out, because the sign of a filtered velocity
            is wrong there; by default 0.05. With `weak` test functions over which the cart is slower than this fraction of its
            fastest stretch; by default 0.2.

    Returns:
        Estimates per experiment and together; those of filtered measurements with the weak form's beside them, which shows their
        bias. A stage without suitable experiments leaves the model's values.

    Raises:
        ValueError: an option is unknown or does not go with another, a value of the model is no number, or a user's own effect
            does not work.

    Source: paper, equations (5) and (6), section 4.2; weak form: Preisig and Rippin, Comput. Chem. Eng. 17 (1993).
    """
    require_working_model(model, batch=False)
    if weighting not in ("residual", "inertia", "none"):
        raise ValueError(f"weighting is {weighting!r}; use 'residual', 'inertia' or 'none'.")
    if weak and cutoff is not None:
        raise ValueError("cutoff belongs to the filter, and the weak form has none; leave out cutoff, or weak=True.")
    if instruments and not weak:
        raise ValueError("instruments are integrals over earlier test functions; add weak=True.")
    near = near_zero if near_zero is not None else NEAR_WEAK if weak else _NEAR
    options = ClosedFormOptions(weak, instruments, weak if reaction is None else reaction, weighting, cutoff, near)
    levels = noise_levels(recording.experiments)
    moves = [e for e in recording.experiments if e.kind != "rest"]
    found = with_constants(closed_form(model, moves, levels, options), moves, levels)
    if weak:
        return found
    beside = ClosedFormOptions(True, False, True, weighting, None, NEAR_WEAK)
    return dataclasses.replace(found, weak=with_constants(closed_form(model, moves, levels, beside), moves, levels))


def starting_values(model: RTAC, recording: Recording) -> RTAC:
    """Return the model with the default estimates of `least_squares`, and compute nothing beside them."""
    options = ClosedFormOptions(False, False, False, "residual", None, _NEAR)
    moving = [e for e in recording.experiments if e.kind != "rest"]
    return closed_form(model, moving, noise_levels(recording.experiments), options).model


def _is_held(experiment: Experiment) -> bool:
    """Return whether dry friction holds the cart all along, so that a count more or less is all that its encoder shows."""
    if "cart_position" not in experiment.outputs:
        return False
    values = experiment.outputs["cart_position"].values
    known = values[np.isfinite(values)]
    return bool(np.ptp(known) < _FEW_COUNTS * resolution(known))


def closed_form(
    model: RTAC,
    experiments: Sequence[Experiment],
    levels: Mapping[str, float],
    options: ClosedFormOptions,
    *,
    settled: bool = False,
) -> ClosedForm:
    """Return the estimates of `least_squares` with its options already made.

    Args:
        model: gives the fixed parameters, and the values from which the turns begin.
        experiments: moving ones.
        levels: noise of each channel, SI units.
        options: how the estimates are made.
        settled: the model is near the result already, as for a replicate of the same recording, so one turn will do.
    """
    uncertain = model.uncertain
    model = model.fix(*uncertain)
    told = {e.name for e in experiments if e.initial_arm_angle is not None}
    experiments = with_initial_angles(model, experiments, levels)
    angles = {
        e.name: e.initial_arm_angle for e in experiments if e.initial_arm_angle is not None and e.name not in told
    }
    skipped: dict[str, str] = {}
    if options.reaction:  # counted with a wrong angle it shifts the stiffness by many of its deviations
        lost = {e.name for e in experiments if e.initial_arm_angle is None and not angle_told(e)}
        for kind in ("free", "forced"):
            alike = [e for e in experiments if e.kind == kind]
            if any(e.name not in lost for e in alike):
                skipped |= {e.name: _LOST.format(e.name) for e in alike if e.name in lost}
        experiments = [e for e in experiments if e.name not in skipped]
    used: dict[str, float] = {}
    held = {e.name for e in experiments if _is_held(e)}
    skipped |= {e.name: _HELD.format(e.name) for e in experiments if e.name in held and e.arm == "locked"}

    def terms(model: RTAC) -> list[Terms]:
        dry = float(model[_DRY]) / float(model["total_mass"]) if _DRY in model.parameters else 0.0
        drive = float(model["torque_constant"]) / float(model["arm_inertia"])
        found = []
        for experiment in experiments:
            try:
                if options.weak:
                    near = options.near_zero
                    found.append(integrated_terms(experiment, levels, near_zero=near, dry_rate=dry, drive_rate=drive))
                else:
                    limit = options.cutoff if options.cutoff is not None else automatic_cutoff(experiment, levels)
                    found.append(sampled_terms(experiment, limit, near_zero=options.near_zero))
                    used[experiment.name] = limit
            except ValueError as error:
                skipped[experiment.name] = str(error)
        return found

    # The weak form needs the dry friction to find the cart's turns, and the arm's reaction in free oscillation needs me,
    # which only forced oscillation gives: both settle in a few turns.
    first = model.with_values({_DRY: 0.0}) if options.weak and not settled and _DRY in model.parameters else model
    ready = terms(first)
    ratios: dict[str, Estimates] = {}
    estimates: dict[str, Estimates] = {}
    more: dict[str, Estimates] = {}
    scales: tuple[str, ...] = ()
    for turn in range(2 if settled else _TURNS if options.weak or options.reaction else 1):
        if options.weak and turn in (1, 2) and not settled:
            ready = terms(model)
        sliding = [t for t in ready if np.any(t.cart["spring"]) and not t.driven and t.name not in held]
        pushed = any(t.pushed for t in sliding)
        free = [t for t in sliding if t.pushed == pushed]
        forced = [t for t in ready if t.driven and t.has_arm and t.arm_free]
        model, ratios, estimates = free_stage(
            model, free, pushed=pushed, reaction=options.reaction, acceleration=options.weak
        )
        scales = unknown_scales(model, pushed=pushed)
        # Of both unknown, me or K_m tells that of the arm's equation, and me then the cart's. Without these the total mass stays
        # what the model has, and the inertia follows from it.
        both = ("arm_inertia", "total_mass") if SCALING & model.fixed else ("arm_inertia",)
        more = {}
        for unknown in scales if len(scales) == 1 else both if scales else ():
            model, own = scale_stage(
                model, forced, estimates, unknown=unknown, alone=not ratios, instruments=options.instruments
            )
            more |= own
        if not more:
            model, more = forced_stage(
                model, forced, weighting=options.weighting, alone=not ratios, instruments=options.instruments
            )
    assumed = tuple(name for name in scales if name not in more)
    kept = {name: found for name, found in (estimates | more).items() if name not in assumed}
    return ClosedForm(model.release(*uncertain), ratios, kept, used, skipped, options, assumed=assumed, angles=angles)


def with_constants(found: ClosedForm, experiments: Sequence[Experiment], levels: Mapping[str, float]) -> ClosedForm:
    """Return the estimates with standard deviations that count those of the constants.

    Each constant is moved by its standard deviation, and every estimate moves with it; they are independent of each other and
    of the noise.

    Args:
        found: of `closed_form`.
        experiments: that it was made from.
        levels: noise of each channel, SI units.
    """

    def again(moved: Mapping[str, float]) -> ClosedForm:
        return closed_form(found.model.with_values(moved), experiments, levels, found.options, settled=True)

    deviations = {n: float(found.model.priors[n].std) for n in found.model.uncertain}
    if not deviations:
        return found
    here = again({})
    there = [again({name: float(found.model[name]) + std}) for name, std in deviations.items()]

    def widened(of: str) -> dict[str, Estimates]:
        before, after = getattr(here, of), [getattr(one, of) for one in there]
        wide = {}
        for name, one in getattr(found, of).items():
            moves = [other[name].value - before[name].value for other in after if name in other and name in before]
            wide[name] = dataclasses.replace(one, std=float(np.sqrt(one.std**2 + np.sum(np.square(moves)))))
        return wide

    return dataclasses.replace(found, ratios=widened("ratios"), estimates=widened("estimates"))
