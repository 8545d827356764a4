"""Description of a recording in words."""

from collections.abc import Mapping

import numpy as np

from rtac_jax.arguments import checked_arguments
from rtac_jax.overview import aligned

from ._contents import Contents
from ._errors import printable
from ._experiment import Experiment
from ._signal import Signal

# The constants of the rig that the README names; others are shown without a unit.
RIG_UNITS: Mapping[str, str] = {
    "total_mass": "kg",
    "arm_inertia": "kg m^2",
    "spring_stiffness": "N/m",
    "torque_constant": "N m/A",
    "eccentric_moment": "kg m",
}
HEADER = ("channel", "unit", "rms", "missing", "noise std", "between samples")


@checked_arguments
def describe(recording: Contents) -> str:
    """Describe the experiments in a readable table: their conditions, and the unit, rms and noise of each channel."""
    experiments = recording.experiments
    total = sum(experiment.samples for experiment in experiments)
    length = sum(experiment.duration for experiment in experiments)
    kinds = [experiment.kind for experiment in experiments]
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    known = ", ".join(
        f"{name} = {value:.6g}{_spread(recording.rig_std.get(name))} {RIG_UNITS.get(name, '')}".rstrip()
        for name, value in recording.rig.items()
    )
    lines = [
        f"rig: {printable(recording.rig_name) or 'not named'}; known beforehand: {known or 'nothing'}",
        *_exact(recording),
        *(f"comment: {printable(line)}" for line in recording.comment.splitlines()),
        f"experiments: {len(experiments)} ({counts}), {total} samples, {length:.6g} s",
    ]
    for experiment in experiments:
        lines += ["", _conditions(experiment), *_table(experiment)]
    return "\n".join(lines)


def _exact(recording: Contents) -> list[str]:
    """Return a line that says which constants no deviation is stated of: what is off in them shifts all that is estimated."""
    exact = [name for name in recording.rig if name not in recording.rig_std]
    if not exact:
        return []
    return [f"without a deviation, so exact: {', '.join(exact)}; give {exact[0]}_std beside {exact[0]} where it is not"]


def _spread(deviation: float | None) -> str:
    return "" if deviation is None else f" +- {deviation:.2g}"


def _conditions(experiment: Experiment) -> str:
    parts = [
        experiment.kind,
        f"{experiment.samples} samples of {experiment.sample_time:.6g} s, {experiment.duration:.6g} s",
    ]
    if experiment.arm == "locked":
        parts.append("arm locked")
    if experiment.cart == "clamped":
        parts.append("cart clamped")
    if experiment.initial_arm_angle is not None:
        spread = _spread(experiment.initial_arm_angle_std)
        parts.append(f"arm starts at {experiment.initial_arm_angle:.4g}{spread} rad")
    if experiment.repeat_of is not None:
        parts.append(f"repeats {experiment.repeat_of}")
    return f"{experiment.name}: {'; '.join(parts)}"


def _table(experiment: Experiment) -> list[str]:
    channels = {**experiment.inputs, **experiment.outputs}
    return [f"  {line}" for line in aligned([HEADER, *(_row(name, signal) for name, signal in channels.items())])]


def _row(name: str, signal: Signal) -> tuple[str, ...]:
    missing = np.isnan(signal.values)
    # Scaled before squaring, since the square of a small number in SI units can vanish.
    size = float(np.nanmax(np.abs(signal.values)))
    rms = size * float(np.sqrt(np.nanmean((signal.values / size) ** 2))) if size else 0.0
    noise = "" if signal.noise_std is None else f"{signal.noise_std:.3g}"
    return name, signal.unit, f"{rms:.4g}", str(int(missing.sum())), noise, signal.intersample or ""
