"""The rig: its recordings, the physics that may act on it, and its motion."""

import importlib.metadata

from rtac_jax import control, effects, virtual_rig
from rtac_jax._design import design_excitation
from rtac_jax._rigid_body import RigidBody
from rtac_jax._rtac import RTAC
from rtac_jax._simulate_experiments import simulate
from rtac_jax._simulate_inputs import simulate_inputs
from rtac_jax._simulation_record import Simulation
from rtac_jax.configuration import configure, require_configured
from rtac_jax.excitation import Excitation
from rtac_jax.linearisation import equation_4, linearise
from rtac_jax.measurement import Experiment, Recording, RecordingError, concerns, describe
from rtac_jax.parameters import Declaration, Scales, parameter
from rtac_jax.storage import ResultFileError, load, save

__version__ = importlib.metadata.version("rtac-jax")
"""Version of the installed distribution, which holds `rtac_jax` and `estimators`."""

__all__ = [
    "RTAC",
    "Declaration",
    "Excitation",
    "Experiment",
    "Recording",
    "RecordingError",
    "ResultFileError",
    "RigidBody",
    "Scales",
    "Simulation",
    "__version__",
    "concerns",
    "configure",
    "control",
    "describe",
    "design_excitation",
    "effects",
    "equation_4",
    "linearise",
    "load",
    "parameter",
    "require_configured",
    "save",
    "simulate",
    "simulate_inputs",
    "virtual_rig",
]
