"""Test of drift: innovations held against what they would be if a parameter changed steadily within experiments."""

import numpy as np
from jaxtyping import Float

from estimators.core.threads import at_once
from estimators.misspecification.findings import ParameterDrift
from estimators.misspecification.score_test import score_test
from estimators.prediction_error.innovations import Innovations, Rows


def parameter_drifts(
    innovations: Innovations, jacobian: Rows, error: np.ndarray, basis: Float[np.ndarray, "row explained"]
) -> list[ParameterDrift]:
    """Test for each free parameter whether it changes in proportion to the time since an experiment began, best first.

    What moves slowly beside the memory of the innovations changes them as its present value does, so that their derivative by a
    rate is their derivative by the parameter times that time.

    Args:
        innovations: of the fitted model.
        jacobian: their derivatives by its free parameters, scaled.
        error: the innovations as rows, without their part in the basis.
        basis: orthonormal columns that the parameters explain already.

    Source: scores against time as in Nyblom, J. Am. Stat. Assoc. 84 (1989), for the alternative of a linear change.
    """
    space = innovations.space
    blocks, time = innovations.blocks(), _seconds(innovations)
    free = [int(place) for place in np.asarray(space.active) if place < len(space.names)]

    def drift(column: int) -> ParameterDrift:
        test = score_test(jacobian[:, [column]] * time[:, None], error, basis, blocks)
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
    samples = sample_time[:, None] * np.arange(data.samples)
    rows = np.repeat(samples.reshape(-1), int(innovations.used.sum()))
    beyond = len(innovations.blocks()) - len(rows)
    return np.concatenate([rows, np.zeros(beyond)])
