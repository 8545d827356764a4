"""One repetition as estimators get it, and what one of them makes of it."""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from estimators.study.truth import Truth
from rtac_jax import RTAC
from rtac_jax.measurement import Recording


class Value(NamedTuple):
    """An estimate: value, stated standard deviation, degrees of freedom of Student's distribution, Table 1's consistency."""

    value: float
    std: float = np.nan
    freedom: float = np.inf
    consistency: float = np.nan


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The outcome of one method on one recording.

    Attributes:
        values: by name of the parameter.
        quantities: by name, see `QUANTITIES`.
        verdict: how the fit ended, or what a diagnosis says.
        named: effects that a diagnosis named, those that it cannot tell apart joined by "|", several by " + ".
    """

    values: Mapping[str, Value] = dataclasses.field(default_factory=dict)
    quantities: Mapping[str, float] = dataclasses.field(default_factory=dict)
    verdict: str = ""
    named: str = ""


class Prepared(NamedTuple):
    """A recording, the model to be fitted to it, and the truth."""

    model: RTAC
    recording: Recording
    truth: Truth
