"""H-infinity control: weights, synthesis, what it guarantees, and the controller in the loop with the nonlinear model."""

from rtac_jax.control._checks import InfeasibleError
from rtac_jax.control._closed_loop import closed_loop
from rtac_jax.control._margins import Margins, margins
from rtac_jax.control._price import Price, price
from rtac_jax.control._reduce import Reduction, discretise, reduce_controller
from rtac_jax.control._response import ClosedLoop
from rtac_jax.control._synthesis import Synthesis, closed_gamma, mixed_sensitivity
from rtac_jax.control._units import Actuation, Units, nominal_plant
from rtac_jax.control._weights import Weights, paper_nominal, paper_uncertainty, paper_weights, propose_weights

__all__ = [
    "Actuation",
    "ClosedLoop",
    "InfeasibleError",
    "Margins",
    "Price",
    "Reduction",
    "Synthesis",
    "Units",
    "Weights",
    "closed_gamma",
    "closed_loop",
    "discretise",
    "margins",
    "mixed_sensitivity",
    "nominal_plant",
    "paper_nominal",
    "paper_uncertainty",
    "paper_weights",
    "price",
    "propose_weights",
    "reduce_controller",
]
