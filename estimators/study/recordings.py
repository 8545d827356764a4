"""The data of repetitions: what is played, on the virtual rig or on the model itself."""

import functools
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from estimators.study.model_simulation import Simulated, simulate_together
from estimators.study.spec import Excitation, StudySpec
from estimators.study.truth import Streams, Truth, as_number
from rtac_jax import RTAC, virtual_rig
from rtac_jax.measurement import Experiment, Recording, from_rest, multisine

NEW = "new_"
"""What the names of conditions begin with that are held against an envelope."""


def recordings(spec: StudySpec, indices: Sequence[int], truths: Sequence[Truth | str]) -> list[Recording | str]:
    """Record the repetitions with these numbers, or say why that is not possible.

    Virtual rigs are integrated together, which takes a tenth of the time and gives each the same bits as alone; so are models.
    """
    jobs: dict[int, tuple[virtual_rig.Rig, Sequence[virtual_rig.Plan], int]] = {}
    simulated: dict[int, tuple[RTAC, Sequence[virtual_rig.Plan]]] = {}
    found: dict[int, Recording | str] = {}
    for index, truth in zip(indices, truths, strict=True):
        if isinstance(truth, str):
            found[index] = truth
            continue
        try:
            plans = plans_for(spec, index, truth)
            if isinstance(truth.source, RTAC):
                simulated[index] = truth.source, plans
            else:
                jobs[index] = truth.source, plans, as_number(Streams.of(spec.seed, index).noise)
        except (ValueError, ArithmeticError) as error:
            found[index] = _why(error)
    try:
        found |= dict(zip(jobs, virtual_rig.record_many(list(jobs.values())) if jobs else [], strict=True))
    except (ValueError, ArithmeticError):  # of one of them: the others still count
        for index, job in jobs.items():
            try:
                found[index] = virtual_rig.record(*job[:2], seed=job[2])
            except (ValueError, ArithmeticError) as error:
                found[index] = _why(error)
    try:
        found |= _simulated(spec, simulated)
    except (ValueError, ArithmeticError):
        for index, job in simulated.items():
            try:
                found |= _simulated(spec, {index: job})
            except (ValueError, ArithmeticError) as error:
                found[index] = _why(error)
    return [found[index] for index in indices]


def plans_for(spec: StudySpec, index: int, truth: Truth) -> list[virtual_rig.Plan]:
    """Return what is played in this repetition."""
    excitation = truth.excitation
    # A key of one number is none of a repetition's, which have two.
    stream = (
        Streams.of(spec.seed, index).plans if excitation.redrawn else np.random.SeedSequence(spec.seed, spawn_key=(0,))
    )
    if excitation.kind == "conditions":
        return _conditions(excitation, np.random.default_rng(stream))
    return virtual_rig.standard_plans(
        seed=as_number(stream), sample_time=excitation.sample_time, duration=excitation.duration, free=excitation.free,
        forced=excitation.forced, rest=excitation.rest, repeats=excitation.repeats, current_rms=excitation.current_rms,
        largest_current=excitation.largest_current, intersample=excitation.intersample,
        played=truth.hidden.played or None,
    )  # fmt: skip


def _conditions(excitation: Excitation, random: np.random.Generator) -> list[virtual_rig.Plan]:
    """Return the conditions drawn independently from one population, those of the envelope first."""
    samples = round(excitation.duration / excitation.sample_time)
    names = [f"condition_{n + 1}" for n in range(excitation.conditions)]
    names += [f"{NEW}{n + 1}" for n in range(excitation.new_conditions)]
    plans = []
    for name in names:
        wave = multisine(
            samples=samples, sample_time=excitation.sample_time,
            rms=excitation.current_rms * float(random.uniform(excitation.smallest, 1.0)),
            band=(excitation.band[0], excitation.band[1]), seed=int(random.integers(2**31)),
        )  # fmt: skip
        angle = float(random.uniform(-excitation.angle, excitation.angle) + np.pi * random.integers(2))
        plans.append(
            virtual_rig.Plan(
                name, "forced", excitation.duration, excitation.sample_time, from_rest(wave), initial_angle=angle
            )
        )
    return plans


def _simulated(spec: StudySpec, jobs: Mapping[int, tuple[RTAC, Sequence[virtual_rig.Plan]]]) -> dict[int, Recording]:
    """Return the models' own simulations with white noise of the sensors."""
    several = {
        index: Simulated(model, [_to_simulate(plan) for plan in moving], [plan.start for plan in moving])
        for index, (model, plans) in jobs.items()
        if (moving := [plan for plan in plans if plan.kind != "rest"])
    }
    shown = dict(zip(several, simulate_together(list(several.values())), strict=True))
    found = {}
    for index, (model, plans) in jobs.items():
        simulated = iter(shown.get(index, ()))
        experiments = tuple(
            _measured(plan, noise, None if plan.kind == "rest" else next(simulated))
            for plan, noise in zip(plans, _noise(spec, index, plans), strict=True)
        )
        known = {name: float(np.asarray(model[name])) for name in ("total_mass", "arm_inertia")}
        comment = f"model, repetition {index}"
        found[index] = Recording(experiments=experiments, rig=known, rig_name="model", comment=comment)
    return found


def _to_simulate(plan: virtual_rig.Plan) -> Experiment:
    """Return the plan as an experiment of which only the inputs are looked at."""
    if plan.current is None and plan.disturbance_force is None:
        return _undriven(plan.name, plan.kind, plan.samples, plan.sample_time, plan.arm, plan.cart)
    return plan.to_simulate()


# A study of free decays simulates what differs in starts and parameters only.
@functools.lru_cache(maxsize=256)
def _undriven(
    name: str,
    kind: Literal["free", "forced", "rest"],
    samples: int,
    sample_time: float,
    arm: Literal["free", "locked"],
    cart: Literal["free", "clamped"],
) -> Experiment:
    return virtual_rig.Plan(name, kind, samples * sample_time, sample_time, arm=arm, cart=cart).to_simulate()


def _measured(
    plan: virtual_rig.Plan, noise: Mapping[str, np.ndarray], simulated: Mapping[str, np.ndarray] | None
) -> Experiment:
    """Return the experiment with these outputs; at rest nothing but noise is in them."""
    outputs = dict(noise) if simulated is None else {name: values + simulated[name] for name, values in noise.items()}
    return plan.experiment(outputs, repeat_of=plan.repeat_of)


def _noise(
    spec: StudySpec, index: int, plans: Sequence[virtual_rig.Plan]
) -> list[dict[str, Float[np.ndarray, " sample"]]]:
    """Return the white noise of the sensors in each experiment, by channel."""
    random = np.random.default_rng(Streams.of(spec.seed, index).noise)
    levels = {"cart_position": spec.noise.position, "arm_velocity": spec.noise.velocity}
    if spec.noise.encoder:
        levels["arm_angle"] = spec.noise.angle
    return [{name: level * random.standard_normal(plan.samples) for name, level in levels.items()} for plan in plans]


def _why(error: Exception) -> str:
    return f"no data: {type(error).__name__}: {' '.join(str(error).split())}"
