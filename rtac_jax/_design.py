"""Design of currents that are safe on the model before the rig plays them: torque, travel, and an arm without grip."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float64

from rtac_jax._rtac import RTAC
from rtac_jax.arguments import checked_arguments
from rtac_jax.effects import Input
from rtac_jax.equations import sensor_outputs, state_at_start
from rtac_jax.excitation import Excitation
from rtac_jax.measurement import DESIGNED, Experiment, Recording
from rtac_jax.programs import program
from rtac_jax.simulation import State, Steps, advance, substeps_for, trajectories
from rtac_jax.time_loop import time_loop

_FEWER = 0.9  # by which an amplitude is lowered until the travel holds
# Periods of the cart without a current after the last sample, in which a motion that still grew is largest.
_AFTER = 2.0
_MOST_TRIES = 60
# Simulations of a record; one more for every time that its arm passes where it has no grip, at most.
_MOST_ROUNDS = 1000
_MOST_SILENT = 0.5  # fraction of the samples that a dead band may silence: an arm that rests in it cannot be driven out


@checked_arguments
def design_excitation(
    model: RTAC,
    current: Float64[np.ndarray, " sample"] | Float64[np.ndarray, "experiment sample"],
    *,
    sample_time: float,
    initial_angles: Sequence[float] = (0.0,),
    amplitudes: Sequence[float] = (1.0,),
    travel: float = 0.015,
    torque_limit: float = 0.1,
    dead_band: float = 0.05,
    name: str = "condition",
) -> Recording:
    """Return a recording that a rig can play: one experiment for each starting angle, within torque and travel.

    The current is scaled until the torque and, by simulation of the model, the cart's travel stay within their limits;
    `amplitudes` then take fractions of that. Where the simulated arm has |cos(theta)| <= `dead_band` the current is zero
    and the arm coasts through, as it cannot move the cart there (paper, section 5.3). Zeroing changes the motion that
    follows, so it is decided sample by sample while the model moves, and the currents agree with their own motion. A rig
    departs from its model in time, so what plays the file should watch the angle by the same rule.

    Args:
        model: its `torque_constant` K_m makes the torque K_m i of a current i.
        current: before scaling [A], held between samples; one for all experiments, or a row for each. Its size is that of
            the largest amplitude asked for. For an output that is equally rich at all frequencies, make it with
            `multisine(..., amplitudes=)` one over the magnitude of the model, `rtac_jax.linearise(model)` from current to
            cart_position, at the harmonics.
        sample_time: [s].
        initial_angles: of the arm at the start [rad], one for each experiment; the cart starts at rest in the middle.
        amplitudes: fraction of the largest safe current [1], for each experiment or in turn.
        travel: largest position of the cart itself to each side [m], whatever its sensor makes of it; also while it swings out
            after the last sample, without a current.
        torque_limit: largest |N| [N m].
        dead_band: [1].
        name: of the experiments, which are numbered.

    Returns:
        Experiments `condition_1`, ... whose outputs are the model's prediction, as the comment says; replace them by
        what the rig shows.

    Raises:
        ValueError: a limit or an amplitude out of its range, a current that is zero or too weak to move the cart, an arm that
            is left without grip for most of the time, or a current
            that breaks the travel even when it is small.
    """
    current = np.asarray(current, dtype=np.float64)
    for label, value in (("travel", travel), ("torque_limit", torque_limit), ("sample_time", sample_time)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{label}: is {value}; give a positive number.")
    if not 0 <= dead_band < 1:
        raise ValueError(f"dead_band: is {dead_band}; |cos(theta)| needs a bound from 0 up to, but not including, 1.")
    if not len(initial_angles) or not len(amplitudes):
        raise ValueError("initial_angles, amplitudes: are empty; give at least one of each.")
    sizes = np.resize(np.asarray(amplitudes, dtype=np.float64), len(initial_angles))
    if not np.all((sizes > 0) & (sizes <= 1)):
        raise ValueError("amplitudes: must be above 0 and at most 1, as fractions of the largest safe current.")
    if not np.all(np.isfinite(current)) or not np.any(current):
        raise ValueError("current: must be finite and not zero throughout; make one with multisine, chirp or prbs.")

    waves = np.broadcast_to(current, (len(initial_angles), current.shape[-1])) if current.ndim == 1 else current
    if len(waves) != len(initial_angles):
        raise ValueError(f"current: has {len(waves)} rows for {len(initial_angles)} initial_angles; give one for each.")
    count = waves.shape[1]
    natural = float(np.asarray(model.body.natural_frequency()))
    if not natural > 0:
        raise ValueError(
            "the model has no spring (spring_stiffness = 0), so nothing brings the cart back; plan its moves."
        )
    period = 2 * np.pi / natural
    longer = np.pad(waves, ((0, 0), (0, int(np.ceil(_AFTER * period / sample_time)))))
    scale = min(1.0, torque_limit / (float(np.asarray(model["torque_constant"])) * float(np.max(np.abs(current)))))
    for _ in range(_MOST_TRIES):
        played, places, outputs = _play(model, scale * sizes[:, None] * longer, initial_angles, sample_time, dead_band)
        farthest = float(np.max(np.abs(places)))
        if farthest <= travel:
            break
        # The cart is nearly linear, so its travel says how much is too much; the factor ends the search in any case.
        scale *= min(_FEWER, travel / farthest)
    else:
        raise ValueError(
            f"travel: the cart leaves {travel:g} m however small the current is; allow it more, or check the model."
        )
    played, places, outputs = played[:, :count], places[:, :count], outputs[:, :count]
    silent = np.mean((played == 0) & (waves != 0), axis=1) > _MOST_SILENT
    if silent.any():
        raise ValueError(
            f"initial_angles: the arm that starts at {initial_angles[int(np.argmax(silent))]:.3g} rad is, or soon comes to rest, "
            "near 90 degrees, where it has no grip on the cart; start elsewhere, or change the current."
        )
    sticks = np.flatnonzero(np.ptp(places, axis=1) == 0)
    if len(sticks):
        raise ValueError(
            f"current: in experiment {int(sticks[0]) + 1} it is too weak to move the cart against its friction; raise it or its "
            "amplitude, or the limit that holds it down."
        )
    experiments = tuple(
        Experiment.of(
            f"{name}_{number + 1}", kind="forced", sample_time=sample_time, current=wave, cart_position=shown[:, 0],
            arm_velocity=shown[:, 1], arm_angle=shown[:, 2], initial_arm_angle=float(angle),
        )
        for number, (wave, angle, shown) in enumerate(zip(played, initial_angles, outputs, strict=True))
    )  # fmt: skip
    comment = (
        "Excitation to be played: the currents are the design, the outputs are the prediction of the model "
        f"({', '.join(model.ids) or 'rigid body'}), {DESIGNED}. Scaled by {scale:.4g} for |N| <= {torque_limit:g} N m and "
        f"|q| <= {travel:g} m; current zero where the predicted |cos(theta)| <= {dead_band:g}."
    )
    return Recording(experiments, rig_name="excitation design", comment=comment)


def _play(
    model: RTAC, currents: np.ndarray, angles: Sequence[float], sample_time: float, dead_band: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return currents that are zero where their own motion has no grip [experiment, sample], the cart's places and the outputs."""
    count = len(currents)
    excitation = Excitation(None, None, jnp.full(count, sample_time), jnp.ones(count), jnp.ones(count))
    rigid = (jnp.zeros(count), jnp.zeros(count), jnp.asarray(angles, dtype=float), jnp.zeros(count))
    start = tuple(jnp.broadcast_to(x, (count,)) for x in state_at_start(model, rigid, jnp.zeros(count)))
    substeps = jnp.asarray(substeps_for(model, excitation, stability=0.5))
    if any(isinstance(effect, Input) for effect in model.effects):
        played, places, outputs = _settled(model, start, excitation, currents.T, dead_band, substeps)
    else:
        played, places, outputs = _closed(
            model, start, excitation, jnp.asarray(currents.T), jnp.asarray(dead_band), substeps
        )
    return np.asarray(played).T, np.asarray(places).T, np.moveaxis(np.asarray(outputs), 2, 0)


@program
def _closed(
    model: RTAC, start: State, excitation: Excitation, currents: Array, dead_band: Array, substeps: Steps
) -> tuple[Array, Array, Array]:
    def one_sample(state: State, wanted: Array) -> tuple[State, tuple[Array, Array, Array]]:
        shown = jnp.stack([jnp.broadcast_to(y, wanted.shape) for y in sensor_outputs(model, state)])
        current = jnp.where(jnp.abs(jnp.cos(state[2])) <= dead_band, 0.0, wanted)
        return advance(model, state, (current,), None, excitation, substeps=substeps), (current, state[0], shown)

    samples = len(currents)
    return time_loop(one_sample, start, currents, room=samples, samples=samples)[1]


def _settled(
    model: RTAC, start: State, excitation: Excitation, wanted: np.ndarray, dead_band: float, substeps: Steps
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what `_closed` does where an input acts across its samples, as a delayed one does.

    The whole record is simulated again until its currents are zero where, and only where, its own motion has no grip: each time
    that holds some samples farther.
    """
    played = wanted
    for _ in range(_MOST_ROUNDS):
        path, outputs = _followed(model, start, excitation, jnp.asarray(played), substeps)
        states = np.asarray(path)
        before, played = played, np.where(np.abs(np.cos(states[:, 2])) <= dead_band, 0.0, wanted)
        if np.array_equal(before, played):
            return played, states[:, 0], np.asarray(outputs)
    late = ", ".join(effect.id for effect in model.effects if isinstance(effect, Input))
    raise ValueError(
        f"model: with {late} no current was found that is zero where, and only where, the arm has no grip; set dead_band=0, or "
        "start the arm elsewhere."
    )


@program
def _followed(
    model: RTAC, start: State, excitation: Excitation, currents: Array, substeps: Steps
) -> tuple[Array, Array]:
    given = dataclasses.replace(excitation, current=currents[:, None, :])
    path = trajectories(model, start, given, samples=len(currents), substeps=substeps, states=True)

    def shown(state: Array) -> Array:
        return jnp.stack([jnp.broadcast_to(y, state[0].shape) for y in sensor_outputs(model, tuple(state))])

    return path, jax.vmap(shown)(path)
