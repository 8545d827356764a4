"""diffrax with the package's steps: classic Runge-Kutta, one step a sample, the current held over it.

diffrax's own methods look up the input at every stage, and the last stage of a step would see the next sample's current. This one
evaluates the equations four times with the current at the beginning of the step, which is less work than any of diffrax's.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Float


class HeldRungeKutta(diffrax.AbstractSolver):
    """The classic Runge-Kutta method, the input held at what it is when the step begins."""

    term_structure: ClassVar = diffrax.ODETerm
    interpolation_cls: ClassVar[Callable[..., Any]] = diffrax.LocalLinearInterpolation

    def order(self, terms: Any) -> int:
        return 4

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> None:
        return None

    def step(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: None, made_jump: Any) -> Any:
        step = t1 - t0
        a = terms.vf(t0, y0, args)
        b = terms.vf(t0, y0 + step / 2 * a, args)
        c = terms.vf(t0, y0 + step / 2 * b, args)
        d = terms.vf(t0, y0 + step * c, args)
        y1 = y0 + step / 6 * (a + 2 * b + 2 * c + d)
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, args)


def simulate(
    derivative: Callable[[Array, Array], Array], start: Float[Array, "4"], held: Float[Array, " sample"], step: float
) -> Float[Array, "sample 4"]:
    """Return the states at the samples, the first of them the start."""

    def vector_field(time: Any, state: Array, currents: Array) -> Array:
        return derivative(state, currents[jnp.round(time / step).astype(int)])

    found = diffrax.diffeqsolve(
        diffrax.ODETerm(vector_field), HeldRungeKutta(), 0.0, step * (len(held) - 1), step, start, args=held,
        stepsize_controller=diffrax.ConstantStepSize(), saveat=diffrax.SaveAt(t0=True, steps=True),
        max_steps=len(held) - 1, adjoint=diffrax.ForwardMode(),
    )  # fmt: skip
    assert found.ys is not None
    return found.ys
