"""A study whose repetitions take milliseconds, for tests of what runs and keeps studies."""

import dataclasses
from typing import Any

from estimators.study import Estimate, Excitation, Fitted, Plant, StudyResults, StudySpec

SHORT = Excitation(duration=0.4, free=1, forced=0, rest=0)
DECAYS = Excitation(duration=1.0, free=3, forced=0, rest=1)
FREE = ("spring_stiffness", "cart_viscous.coefficient", "cart_coulomb.level")


def small(**changes: Any) -> StudySpec:
    """Free decays of 80 samples, and the closed form."""
    spec = StudySpec(
        name="small",
        repetitions=12,
        seed=5,
        estimate=(Estimate("least_squares", options={"cutoff": 20.0}),),
        plant=Plant(spread=0.1),
        excitation=(SHORT,),
    )
    return dataclasses.replace(spec, **changes)


def batched(**changes: Any) -> StudySpec:
    """Decays of two kinds, fitted by output error side by side."""
    fits: dict[str, Any] = {
        "repetitions": 8,
        "excitation": (DECAYS, dataclasses.replace(DECAYS, name="two", free=2)),
        "model": Fitted(free=FREE, start="truth"),
        "estimate": (Estimate("output_error"),),
    }
    return small(**fits | changes)


def same_bits(one: StudyResults, other: StudyResults) -> bool:
    """Whether two results hold the same repetitions with the same bits in every variable."""

    def bits(results: StudyResults) -> dict[str, Any]:
        arrays = results.arrays
        texts = results.layout.texts
        return {n: list(map(str, a.ravel())) if n in texts else a.tobytes() for n, a in arrays.items()}

    return list(one.index) == list(other.index) and bits(one) == bits(other)
