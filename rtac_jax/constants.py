"""Constants of a rig that are known beforehand: which there are, and which sizes no rig has."""

from collections.abc import Mapping

from rtac_jax._model_tables import Parameters

# How far a known constant may be from the paper's, up or down. A rig as large as a building has 10^9 times the inertia;
# beyond this, what is squared and divided in a fit overflows.
FARTHEST = 1e15


def require_constants(model: Parameters, rig: Mapping[str, float]) -> None:
    """Refuse constants that a model does not have, and values that no rig has.

    Args:
        model: an `RTAC` at the paper's values.
        rig: constants by name, SI units.

    Raises:
        ValueError: a name is none of the model's parameters, or a value is far from any rig's.
    """
    if unknown := sorted(set(rig) - set(model.parameters)):
        raise ValueError(
            f"/rig names {', '.join(unknown)}, which this model does not have; it has {', '.join(model.parameters)}."
        )
    papers = {name: float(model[name]) for name in rig}
    odd = [
        f"{name} is {value:g} {model.parameters[name].unit} (the paper's is {papers[name]:g})"
        for name, value in rig.items()
        if value != 0 and not 1 / FARTHEST < abs(value / papers[name]) < FARTHEST
    ]
    if odd:
        raise ValueError(f"/rig: {' and '.join(odd)}, which no rig has; correct the value or its unit.")
