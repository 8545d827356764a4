"""The rig: what was recorded, what physics may act on it, and how it moves."""

from rtac_jax._configure import configure, require_configured
from rtac_jax._excitation import Excitation
from rtac_jax._parameter import Declaration, Scales, parameter
from rtac_jax._rigid_body import RigidBody
from rtac_jax._rtac import RTAC

__all__ = ["RTAC", "Declaration", "Excitation", "RigidBody", "Scales", "configure", "parameter", "require_configured"]
