"""The data of repetitions: what is played, on the virtual rig or on the model itself."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from estimators.study.spec import Excitation, StudySpec
from estimators.study.truth import Streams, Truth, as_number
from rtac_jax import RTAC, simulate, virtual_rig
from rtac_jax.measurement import Experiment, Recording, from_rest, multisine

NEW = "new_"
"""What the names of conditions begin with that are held against an envelope."""


def recordings(spec: StudySpec, indices: Sequence[int], truths: Sequence[Truth | str]) -> list[Recording | str]:
    """Record the repetitions with these numbers, or say why that is not possible.

    Virtual rigs are integrated together, which takes a tenth of the time and gives each the same bits as alone.
    """
    jobs: dict[int, tuple[virtual_rig.Rig, Sequence[virtual_rig.Plan], int]] = {}
    found: dict[int, Recording | str] = {}
    for index, truth in zip(indices, truths, strict=True):
        if isinstance(truth, str):
            found[index] = truth
            continue
        try:
            plans = plans_for(spec, index, truth)
            if isinstance(truth.source, RTAC):
                found[index] = _simulated(spec, index, truth.source, plans)
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
    """Conditions drawn independently from one population, those of the envelope first."""
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


def _simulated(spec: StudySpec, index: int, model: RTAC, plans: Sequence[virtual_rig.Plan]) -> Recording:
    """Return the model's own simulation with white noise of the sensors."""
    random = np.random.default_rng(Streams.of(spec.seed, index).noise)
    levels = {"cart_position": spec.noise.position, "arm_velocity": spec.noise.velocity}
    if spec.noise.encoder:
        levels["arm_angle"] = spec.noise.angle
    bare = []
    for plan in plans:
        fields: dict[str, Any] = {
            "kind": plan.kind, "sample_time": plan.sample_time, "current": plan.current,
            "disturbance_force": plan.disturbance_force, "intersample": plan.intersample,
            "initial_arm_angle": plan.initial_angle, "arm": plan.arm, "cart": plan.cart, "repeat_of": plan.repeat_of,
        }  # fmt: skip
        noise: dict[str, Any] = {name: level * random.standard_normal(plan.samples) for name, level in levels.items()}
        bare.append(Experiment.of(plan.name, **fields, **noise))
    starts = {p.name: [p.initial_position, p.initial_velocity, p.initial_angle, p.initial_arm_velocity] for p in plans}
    shown = simulate(model, [e for e in bare if e.kind != "rest"], start=starts)
    moved = []
    for experiment in bare:
        outputs = dict(experiment.outputs)
        if experiment.kind != "rest":
            for name, signal in outputs.items():
                values = signal.values + getattr(shown[experiment.name], name)
                outputs[name] = dataclasses.replace(signal, values=values)
        moved.append(dataclasses.replace(experiment, outputs=outputs))
    known = {name: float(np.asarray(model[name])) for name in ("total_mass", "arm_inertia")}
    return Recording(experiments=tuple(moved), rig=known, rig_name="model", comment=f"model, repetition {index}")


def _why(error: Exception) -> str:
    return f"no data: {type(error).__name__}: {' '.join(str(error).split())}"
