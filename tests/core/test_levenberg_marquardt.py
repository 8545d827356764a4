"""The optimiser gives back the factor of where it came to rest, which it does not compute anew."""

import jax.numpy as jnp
import numpy as np
import pytest
from hidden_effects import recorded

import estimators as est
import rtac_jax as rtac
from estimators.core.jacobian_factor import factor
from estimators.core.levenberg_marquardt import solve
from estimators.core.linearisation import Problem, at_fit


@pytest.fixture(scope="module")
def problem() -> Problem:
    recording = recorded({"nothing": {}}, first=41)["nothing"]
    return at_fit(est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False), recording)


@pytest.mark.parametrize("most", [1, 3, 60])
def test_factor_is_that_of_the_unknowns(problem: Problem, most: int) -> None:
    arguments, unknowns = problem.arguments, problem.unknowns
    away = unknowns._replace(shared=unknowns.shared + 0.3 * jnp.asarray(np.cos(np.arange(len(unknowns.shared)))))
    solved = solve(away, arguments, most=most)
    np.testing.assert_array_equal(solved.factor, np.asarray(factor(solved.unknowns, arguments)))
    np.testing.assert_allclose(solved.cost, 0.5 * np.sum(solved.factor[..., -1] ** 2), rtol=1e-9)
