"""Checks of the linear systems that the functions of this package are given."""

import control as ct
import numpy as np
from jaxtyping import Complex, Float

Linear = ct.StateSpace | ct.TransferFunction
Poles = Complex[np.ndarray, " pole"]


class InfeasibleError(ValueError):
    """A demand that no controller meets; the message says where and what to relax."""


def state_space(system: object) -> ct.StateSpace:
    """Return a system as state space; python-control declares its results wider than they are.

    Raises:
        TypeError: it is not a linear system.
    """
    found = ct.ss(system)
    if not isinstance(found, ct.StateSpace):
        raise TypeError(f"expected a linear system, but got {type(found).__name__}.")
    return found


def poles_of(system: Linear) -> Poles:
    """Return the poles [rad/s]."""
    return np.array(system.poles(), dtype=complex)


def zeros_of(system: Linear) -> Poles:
    """Return the zeros [rad/s]."""
    return np.array(system.zeros(), dtype=complex)


def is_stable(system: Linear) -> bool:
    """Return whether all poles lie in the left half plane."""
    return bool(np.all(np.real(poles_of(system)) < 0))


def closed(plant: ct.StateSpace, controller: ct.StateSpace) -> ct.StateSpace:
    """Return the closed loop u = -C y, as complementary sensitivity."""
    return state_space(ct.feedback(plant * controller, 1))


def coefficients(system: ct.TransferFunction) -> tuple[Float[np.ndarray, " zeros"], Float[np.ndarray, " poles"]]:
    """Return numerator and denominator, falling powers."""
    return np.array(system.num[0][0], dtype=float), np.array(system.den[0][0], dtype=float)


def plant_of(system: Linear) -> ct.StateSpace:
    """Return a nominal plant as state space.

    Raises:
        ValueError: it is not a continuous, one-to-one, proper and finite linear system.
    """
    _examine(system, "the nominal plant")
    return state_space(system)


def recursion_of(system: Linear) -> tuple[ct.StateSpace, float]:
    """Return a sampled controller as state space, and its sample time [s].

    Raises:
        ValueError: it is not a one-to-one, proper and finite linear system with a sample time.
    """
    if system.dt is True or system.dt is None:
        raise ValueError("the controller is discrete without a sample time; give its dt in seconds.")
    _examine(system, "the controller", sampled=True)
    return state_space(system), float(system.dt)


def weight_of(system: Linear, name: str) -> ct.TransferFunction:
    """Return a weight as a transfer function.

    Raises:
        ValueError: it is not a continuous, one-to-one, proper, stable and finite linear system.
    """
    _examine(system, f"the {name} weight")
    if not is_stable(system):
        poles = poles_of(system)
        worst = poles[np.argmax(np.real(poles))]
        raise ValueError(
            f"the {name} weight has a pole at {worst:.3g}, but must be stable; mirror it into the left half plane."
        )
    return ct.TransferFunction(*coefficients(ct.TransferFunction(system)))


def finite_response(system: Linear, frequency: Float[np.ndarray, " w"], name: str) -> Complex[np.ndarray, " w"]:
    """Return the frequency response over rad/s.

    Raises:
        ValueError: it is not finite everywhere.
    """
    found = np.atleast_1d(np.asarray(system(1j * frequency), dtype=complex))
    if not np.all(np.isfinite(found)):
        raise ValueError(f"the response of {name} is not finite at {frequency[~np.isfinite(found)][0]:.3g} rad/s.")
    return found


def _examine(system: Linear, name: str, *, sampled: bool = False) -> None:
    if not isinstance(system, (ct.StateSpace, ct.TransferFunction)):
        raise ValueError(f"{name} is a {type(system).__name__}; give a python-control StateSpace or TransferFunction.")
    if (system.ninputs, system.noutputs) != (1, 1):
        raise ValueError(f"{name} has {system.ninputs} inputs and {system.noutputs} outputs; give one of each.")
    if system.dt and not sampled:
        raise ValueError(f"{name} is discrete; give it in continuous time.")
    if isinstance(system, ct.StateSpace):
        parts = [system.A, system.B, system.C, system.D]
    else:
        parts = list(coefficients(system))
        if len(np.trim_zeros(parts[0], "f")) > len(np.trim_zeros(parts[1], "f")):
            raise ValueError(f"{name} has more zeros than poles; add poles beyond the band that matters.")
    if not all(np.all(np.isfinite(np.asarray(part))) for part in parts):
        raise ValueError(f"{name} has a coefficient that is not finite.")
