"""Test of drift: innovations held against what they would be if a parameter changed steadily within experiments."""

import numpy as np
from jaxtyping import Float

from estimators.core.threads import at_once
from estimators.misspecification.findings import ParameterDrift
from estimators.misspecification.score_test import score_test
from estimators.prediction_error.innovations import Innovations, Rows, orthonormal


def parameter_drifts(innovations: Innovations, jacobian: Rows, error: np.ndarray) -> list[ParameterDrift]:
    """Test for each free parameter whether it changes in proportion to the time since an experiment began, best first.

    What moves slowly beside the memory of the innovations changes them as its present value does, so that their derivative by a
    rate is their derivative by the parameter times that time. What other values of all parameters in each experiment would explain
    is left out of it: of long and short experiments that differ, the time would tell which is which.

    Args:
        innovations: of the fitted model.
        jacobian: their derivatives by its free parameters, scaled.
        error: the innovations as rows.

    Source: scores against time as in Nyblom, J. Am. Stat. Assoc. 84 (1989), for the alternative of a linear change.
    """
    space = innovations.space
    blocks, time, experiment = innovations.blocks(), _seconds(innovations), _experiments(innovations)
    free = [int(place) for place in np.asarray(space.active) if place < len(space.names)]
    own = [(experiment == e, orthonormal(jacobian[experiment == e][:, : len(free)])) for e in np.unique(experiment)]

    def within(columns: np.ndarray) -> np.ndarray:
        left = columns.copy()
        for rows, basis in own:
            left[rows] -= basis @ (basis.T @ columns[rows])
        return left

    left, nothing = within(error), np.zeros((len(error), 0))

    def drift(column: int) -> ParameterDrift:
        test = score_test(within(jacobian[:, [column]] * time[:, None]), left, nothing, blocks)
        place = free[column]
        scale = float(np.asarray(space.scale)[place])
        rate, std = test.coefficients[0] * scale, test.std[0] * scale
        name = space.names[place]
        return ParameterDrift(
            parameter=name, rate=float(rate), std=float(std), value=float(np.asarray(space.values)[place]),
            unit=innovations.model.parameters[name].unit, p_value=float(test.p_value), excess=float(test.excess),
        )  # fmt: skip

    return sorted(at_once(drift, range(len(free))), key=lambda one: -one.excess)


def _seconds(innovations: Innovations) -> Float[np.ndarray, " row"]:
    """Return the time of every row since its experiment began [s]; zero for what was measured beforehand."""
    data = innovations.data
    sample_time = np.broadcast_to(np.asarray(data.excitation.sample_time), (data.experiments,))
    return _by_row(innovations, sample_time[:, None] * np.arange(data.samples), 0.0)


def _experiments(innovations: Innovations) -> Float[np.ndarray, " row"]:
    """Return the number of every row's experiment; what was measured beforehand is one of its own."""
    data = innovations.data
    return _by_row(
        innovations, np.repeat(np.arange(data.experiments)[:, None], data.samples, axis=1), float(data.experiments)
    )


def _by_row(
    innovations: Innovations, values: Float[np.ndarray, "experiment sample"] | np.ndarray, beyond: float
) -> Float[np.ndarray, " row"]:
    """Return one value for every row, of its experiment and sample, and another for what was measured beforehand."""
    rows = np.repeat(values.reshape(-1), int(innovations.used.sum())).astype(float)
    return np.concatenate([rows, np.full(len(innovations.blocks()) - len(rows), beyond)])
