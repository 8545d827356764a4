"""The largest error of a comparison over the noise, as a number and in words."""

from estimators.validation.simulation_error import Compared


def largest(compared: Compared) -> float:
    """Return the largest error over the noise."""
    worst = compared.worst(1)[0]
    return worst.rms / worst.noise


def largest_error(compared: Compared, held_out: bool) -> str:
    """Return the largest error over the noise, and where it is, in words."""
    worst = compared.worst(1)[0]
    kind = "held-out" if held_out else "fitted"
    return (
        f"the model leaves at most {largest(compared):.3g} times the noise of the {kind} experiments, in "
        f"{worst.channel.replace('_', ' ')} of {worst.experiment}"
    )
