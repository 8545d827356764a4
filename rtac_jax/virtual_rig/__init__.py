"""A rig to practise on: an independent simulator whose truth is known, hidden effects included.

It shares no code with the model: plain NumPy, another integrator, friction that really sticks. What a model
finds in its recordings it has not put there itself.
"""

from rtac_jax.measurement.plan import Plan

from ._plans import standard_plans
from ._record import record, record_many
from ._rig import Rig

__all__ = ["Plan", "Rig", "record", "record_many", "standard_plans"]
