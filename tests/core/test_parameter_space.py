"""The space of a fit's unknowns."""

import equinox as eqx
import numpy as np

from estimators.core.parameter_space import Space, Unknowns


def test_known_numbers_become_physical_as_traced_ones_do() -> None:
    """Of four shared parameters three are free; one unknown does nothing, and one state at the start is held."""
    random, infinite = np.random.default_rng(3), np.inf
    space = Space(
        values=np.array([1.0, 2.0, 3.0, 4.0]), active=np.array([2, 0, 3, 4]),
        lower=np.array([0.0, -infinite, 0.5, -infinite]), upper=np.array([infinite, infinite, 9.0, 5.0]),
        scale=np.array([1.0, 1.0, 2.0, 0.5]), each_values=np.ones((1, 2)), each_lower=np.zeros(1), each_upper=np.full(1, infinite),
        each_scale=np.full(1, 0.1), start=random.standard_normal((2, 2)), start_scale=np.full((2, 2), 0.3),
        start_spread=np.full((2, 2), infinite), start_held=np.array([[1.0, 0.0], [0.0, 0.0]]),
        names=("a", "b", "c", "d"), each=("e",),
    )  # fmt: skip
    unknowns = Unknowns(*(random.standard_normal(shape) for shape in ((4,), (1, 2), (2, 2))))
    known, traced = space.physical(unknowns), eqx.filter_jit(Space.physical)(space, unknowns)
    for one, other in zip(known, traced, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-14)
    shared, _, start = known
    assert shared[1] == 2.0
    assert np.all(np.asarray(shared)[[0, 2, 3]] != space.values[[0, 2, 3]])
    assert start[0, 0] == space.start[0, 0]
    assert np.all(np.asarray(start).ravel()[1:] != space.start.ravel()[1:])
