"""Sampling of nonlinear plants whose linearisation lies inside an envelope."""

from typing import Any

import numpy as np

from estimators.uncertainty.envelope import Envelope
from rtac_jax import RTAC
from rtac_jax.control import Actuation
from rtac_jax.effects import DryFriction, Force
from rtac_jax.linearisation import linear_matrices

_AT_ONCE = 10_000  # plants drawn before it is counted how many lie inside
_MOST = 20  # such draws
_DAMPED = 50.0  # factor by which friction may be larger that stands for dry friction


def plants_inside(
    covered: Envelope, model: RTAC, actuation: Actuation, *, off: float, count: int, seed: int = 0
) -> RTAC | None:
    """Draw plants about a model, and keep those whose linearisation an envelope covers, as a batch.

    They have no dry friction. Of that an envelope of linear plants knows only how much it damps, so the other friction at
    its place is drawn over a wide range, and the envelope chooses. What the envelope does not see is not chosen
    by it: how far the arm swings, which does not show in the cart's position.

    Args:
        covered: from the current that the controller asks for [A] to cart position [m], with the electric spring.
        model: about which they are drawn, on a logarithmic scale.
        actuation: with that spring.
        off: largest relative deviation of every other parameter [1].
        count: of plants; fewer where few of many that were drawn lie inside.
        seed: of the draws.

    Returns:
        None where no plant lies inside.
    """
    dry = {effect.id: effect.port for effect in model.effects if isinstance(effect, DryFriction)}
    middle, random, found = model.without(*dry), np.random.default_rng(seed), []
    damping = {  # not what has states of its own, which moves the resonance and does not only damp it
        e.id
        for e in middle.effects
        if isinstance(e, Force) and e.nature == "dissipative" and not e.states and e.port in dry.values()
    }
    size, damped = np.log(1 + off), np.log(_DAMPED)
    for _ in range(_MOST):
        values = {
            name: float(middle[name])
            * np.exp(random.uniform(-size, damped if name.split(".")[0] in damping else size, _AT_ONCE))
            for name in middle.parameters
        }
        inside = _inside(covered, middle, values, actuation)
        found.append({name: value[inside] for name, value in values.items()})
        if sum(len(one["total_mass"]) for one in found) >= count:
            break
    kept = {name: np.concatenate([one[name] for one in found])[:count] for name in middle.parameters}
    return middle.with_values(kept) if len(kept["total_mass"]) else None


def _inside(covered: Envelope, model: RTAC, values: dict[str, np.ndarray], actuation: Actuation) -> np.ndarray:
    """Return which plants are stable and covered, with the electric spring.

    The drive that makes the spring believes the model's torque constant.
    """
    a, b, c = linear_matrices(model, values)
    held = a - actuation.arm_stiffness / float(model["torque_constant"]) * b[:, :, :1] @ c[:, 2:3]
    eigen: Any = np.linalg.eig(held)
    poles, vectors = eigen
    residues = (c[:, :1] @ vectors)[:, 0] * np.linalg.solve(vectors, b[:, :, :1].astype(complex))[:, :, 0]
    response = np.zeros((len(a), len(covered.frequency)), dtype=np.complex128)
    for state in range(poles.shape[1]):
        response += residues[:, state, None] / (1j * covered.frequency - poles[:, state, None])
    return np.all(poles.real < 0, axis=1) & covered.covers(response)
