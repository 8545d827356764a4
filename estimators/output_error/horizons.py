"""Growing horizons: a long recording is fitted from its beginning on, as a wrong parameter tells ever more the longer it acts."""

import dataclasses

import numpy as np

from estimators.core.data import Data
from estimators.core.fisher_information import information
from estimators.core.jacobian_factor import Arguments, diverged, factor
from estimators.core.parameter_space import Unknowns

FIRST = 8192
"""Samples of the first horizon: as many as are fitted at once of what is cut into pieces."""
GROWTH = 4
"""Times that a horizon is longer than the one before; the phase that parameters fitted to one leave undecided grows by as much."""


def horizons(arguments: Arguments, unknowns: Unknowns) -> list[Data]:
    """Return the beginnings of the data, each longer than the one before, and last all of them.

    Where the first would leave parameters free, all of the data alone.

    Args:
        arguments: of a free simulation of all data.
        unknowns: where the fit begins.

    Source: Ribeiro et al., Automatica 121 (2020), on why the cost of long simulations has many minima.
    """
    data = arguments.data
    lengths = []
    length = FIRST
    while GROWTH * length <= 2 * data.samples and length < data.samples:
        lengths.append(length)
        length *= GROWTH
    if not lengths:
        return [data]
    first = factor(unknowns, dataclasses.replace(arguments, data=data.beginning(lengths[0])))
    if diverged(first) or information(np.asarray(first), arguments.space, unknowns).undetermined():
        return [data]
    return [*(data.beginning(length) for length in lengths), data]
