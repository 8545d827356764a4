"""A controller from the project's own weights for the cart of the paper, and frequency responses to judge it by."""

import control as ct
import numpy as np

from rtac_jax import RTAC, RigidBody
from rtac_jax.control import (
    Actuation,
    Units,
    mixed_sensitivity,
    nominal_plant,
    propose_weights,
)
from rtac_jax.effects import ArmViscous, CartViscous

M, J, ME, K, KM = 1.23, 9.5e-5, 1.06e-3, 132.6, 8.04e-2
VISCOUS, KV = 0.5543, 1.44e-4
SMOOTH = RTAC(RigidBody(M, J, ME, K, KM), (CartViscous(VISCOUS), ArmViscous(KV, KV)))
OMEGA = np.unique(np.concatenate([np.geomspace(1e-2, 1e4, 4000), np.linspace(5, 20, 3000)]))


def response(system: ct.StateSpace | ct.TransferFunction) -> np.ndarray:
    return np.asarray(system(1j * OMEGA))


def own_design(width: float = 0.8) -> tuple:
    """Plant, weights and synthesis for Table 1(c), from the proposals alone."""
    model = RTAC.paper()
    units, actuation = Units.nondimensional(model), Actuation.proposed(model)
    plant = nominal_plant(model, actuation=actuation)
    weights = propose_weights(
        plant, ct.tf([width], [1]), actuation.controller_limit * units.torque, displacement=0.015 * units.position
    )
    return units, actuation, plant, weights, mixed_sensitivity(plant, weights)
