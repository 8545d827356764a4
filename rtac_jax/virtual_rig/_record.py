"""Carry out plans on a virtual rig, and record what its sensors show."""

from collections.abc import Mapping, Sequence

import numpy as np

from rtac_jax.measurement import Experiment, Recording
from rtac_jax.measurement.plan import Plan

from ._motion import Track, integrate
from ._rig import Rig


def record(
    rig: Rig,
    plans: Sequence[Plan],
    *,
    seed: int,
    step: float = 2e-4,
    write_noise: bool = False,
    constants_std: Mapping[str, float] | None = None,
) -> Recording:
    """Carry out plans on a rig.

    Args:
        rig: the truth.
        plans: the experiments, with names of their own.
        seed: of all noise; each plan has its own stream, by its place in the list.
        step: upper bound of the integration step [s]; a whole number of steps fits into a sample.
        write_noise: also write the standard deviation of each output into the recording.
        constants_std: of `total_mass` [kg] and `arm_inertia` [kg m^2], or one of them: the standard deviation of a
            weighing, by which the recording's constant is off by chance, and which it states.

    Returns:
        A recording with one experiment per plan. It knows `total_mass` and `arm_inertia`, exactly by default, and the
        arm's starting angle, which is set by hand on the rig; everything else is noisy or unknown. The
        recorded current is the commanded one.

    Raises:
        ValueError: no plans, two plans of one name, a step that is not positive, or a deviation of something else.
    """
    return record_many([(rig, plans, seed)], step=step, write_noise=write_noise, constants_std=constants_std)[0]


def record_many(
    jobs: Sequence[tuple[Rig, Sequence[Plan], int]],
    *,
    step: float = 2e-4,
    write_noise: bool = False,
    constants_std: Mapping[str, float] | None = None,
) -> list[Recording]:
    """Carry out the plans of many rigs at once; `record`'s results, in a fraction of the time.

    Args:
        jobs: rig, plans and seed of each recording; the noise of a recording depends on its own seed alone.
        step: upper bound of the integration step [s].
        write_noise: also write the standard deviation of each output.
        constants_std: as `record` takes it.

    Raises:
        ValueError: a job without plans, two plans of one name in a job, a step that is not positive, or a deviation of
            something else than the constants that a recording knows.
    """
    if not step > 0:
        raise ValueError(f"step is {step!r}; it must be positive.")
    moving, streams = [], []
    for rig, plans, seed in jobs:
        names = [plan.name for plan in plans]
        if not names:
            raise ValueError("There are no plans to carry out.")
        if len(set(names)) < len(names):
            raise ValueError(f"Plans need names of their own; got {names}.")
        for plan, stream in zip(plans, np.random.SeedSequence(seed).spawn(len(plans)), strict=True):
            forces, sensors = stream.spawn(2)
            moving.append((rig, plan, forces))
            streams.append(sensors)
    tracks = iter(zip(integrate(moving, step), streams, strict=True))
    recordings = []
    for rig, plans, seed in jobs:
        experiments = []
        for plan in plans:
            track, stream = next(tracks)
            outputs = measure(rig, track, np.random.default_rng(stream))
            experiments.append(_experiment(rig, plan, outputs, write_noise))
        recordings.append(
            Recording(
                experiments=tuple(experiments),
                rig=_constants(rig, np.random.SeedSequence(seed, spawn_key=(len(plans),)), constants_std or {}),
                rig_name="virtual rig",
                comment=f"virtual rig, seed {seed}",
            )
        )
    return recordings


def _constants(rig: Rig, stream: np.random.SeedSequence, deviations: Mapping[str, float]) -> dict[str, float]:
    """Return what is known of the rig beforehand: exact, or as a weighing with these standard deviations finds it."""
    known = {"total_mass": rig.total_mass, "arm_inertia": rig.arm_inertia}
    if unknown := sorted(set(deviations) - set(known)):
        raise ValueError(f"constants_std names {', '.join(unknown)}; it may name {', '.join(known)}.")
    error = dict(zip(known, np.random.default_rng(stream).standard_normal(len(known)), strict=True))
    weighed = {name: value + deviations.get(name, 0.0) * float(error[name]) for name, value in known.items()}
    return weighed | {f"{name}_std": float(std) for name, std in deviations.items()}


def measure(rig: Rig, track: Track, random: np.random.Generator) -> dict[str, np.ndarray]:
    """Return what the sensors show of a motion.

    Returns:
        cart_position [m], arm_velocity [rad/s] and, with an encoder, arm_angle [rad], each (N,).
    """
    noise = random.standard_normal((3, track.position.size))
    if rig.noise_correlation:
        fresh = np.sqrt(1 - rig.noise_correlation**2)
        for n in range(1, noise.shape[1]):
            noise[:, n] = rig.noise_correlation * noise[:, n - 1] + fresh * noise[:, n]
    noise *= rig.noise_factor
    turn = 2 * np.pi * track.seen_position / rig.lvdt_ripple_pitch + rig.lvdt_ripple_phase
    position = track.seen_position + rig.lvdt_cubic * track.seen_position**3 + rig.lvdt_ripple * np.sin(turn)
    position = rig.lvdt_gain * position + rig.lvdt_offset + rig.position_noise * noise[0]
    ripple = rig.tacho_ripple * np.sin(rig.tacho_ripple_order * track.angle + rig.tacho_ripple_phase)
    velocity = rig.tacho_gain * (1 + ripple) * track.seen_arm_velocity + rig.tacho_bias
    velocity = velocity + rig.velocity_noise * noise[1]
    outputs = {
        "cart_position": _convert(position, rig.position_range, rig.quantisation_bits),
        "arm_velocity": _convert(velocity, rig.velocity_range, rig.quantisation_bits),
    }
    if rig.encoder:
        ripple = rig.encoder_ripple * np.sin(rig.encoder_ripple_order * track.seen_angle + rig.encoder_ripple_phase)
        angle = rig.encoder_gain * (track.seen_angle + ripple) + rig.encoder_offset
        outputs["arm_angle"] = angle + rig.angle_noise * noise[2]
    return outputs


def _convert(value: np.ndarray, limit: float, bits: int | None) -> np.ndarray:
    """Convert analogue to digital: whole multiples of the least significant bit, within the range."""
    if bits is None:
        return value
    levels = 2 ** (bits - 1)
    return np.clip(np.round(value / limit * levels), -levels, levels - 1) * (limit / levels)


def _experiment(rig: Rig, plan: Plan, outputs: dict[str, np.ndarray], write_noise: bool) -> Experiment:
    noise: dict[str, float] = {}
    if write_noise:
        scale = {
            "cart_position": (rig.position_noise, rig.position_range),
            "arm_velocity": (rig.velocity_noise, rig.velocity_range),
        }
        for name, (spread, limit) in scale.items():
            bit = 0.0 if rig.quantisation_bits is None else limit / 2 ** (rig.quantisation_bits - 1)
            noise[name] = float(np.sqrt(spread**2 + bit**2 / 12))
        if rig.encoder:
            noise["arm_angle"] = rig.angle_noise
    return plan.experiment(outputs, repeat_of=plan.repeat_of, noise_std=noise)
