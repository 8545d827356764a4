"""The tools that fit the same problem: the package, SciPy's least squares over Numba, and optimistix over diffrax.

Each function returns a function without arguments that fits once and returns the parameters and the rms of what is left over the
noise. Starts are given exactly, held at what the first samples show, or free.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from measuring import best_of
from same_problem import NAMES, OFF, RIG, STEP, TRUE, Problem, model_for

Fit = Callable[[], tuple[np.ndarray, float]]
MASS, INERTIA = RIG.total_mass, RIG.arm_inertia


def starts_of(problem: Problem, starts: str) -> np.ndarray:
    """Return the states at the start to begin at, [experiment state]."""
    return problem.start if starts == "given" else problem.shown


def package(problem: Problem, starts: str) -> Fit:
    """Return the package's fit: of the parameters alone, or `output_error` as a user calls it."""
    import estimators as est
    from estimators.core.data import CHANNELS, Data, moving, pieces
    from estimators.core.initial_state import space_of
    from estimators.core.jacobian_factor import Arguments
    from estimators.core.levenberg_marquardt import solve
    from estimators.core.residual import diagonal_whitener

    model = model_for(problem.recording)
    if starts == "free":

        def whole() -> tuple[np.ndarray, float]:
            fit = est.output_error(model, problem.recording, progress=False)
            left = np.array([fit.residual_std["cart_position"], fit.residual_std["arm_velocity"]]) / problem.noise
            return np.array([float(fit.model[n]) for n in NAMES]), float(np.sqrt(np.mean(left**2)))

        return whole

    # The peers have their arrays beforehand, too.
    experiments = pieces(moving(problem.recording))
    data = Data.of(experiments)
    begin = {e.name: x for e, x in zip(experiments, starts_of(problem, starts), strict=True)}
    space = space_of(model, experiments, free=model.free, start=begin)
    noise = np.ones(len(CHANNELS))
    noise[[CHANNELS.index(c) for c in ("cart_position", "arm_velocity")]] = problem.noise
    arguments = Arguments(model, data, space, diagonal_whitener(noise, data), None, 1)

    def parameters_alone() -> tuple[np.ndarray, float]:
        solved = solve(space.unconstrained(start=False), arguments)
        shared = np.asarray(space.physical(solved.unknowns)[0])
        values = dict(zip(space.names, shared, strict=True))
        return np.array([values[n] for n in NAMES]), float(np.sqrt(2 * solved.cost / problem.measured.size))

    return parameters_alone


def _numba_simulator(*, parallel: bool) -> Any:
    import numba

    experiments_of = numba.prange if parallel else range

    @numba.njit(fastmath=True)
    def rates(q, w, p, r, i, me, k, km, v, kv1, kv2):
        sine, cosine = np.sin(p), np.cos(p)
        force = -k * q - v * w + me * r * r * sine
        torque = km * i - (kv1 if r > 0 else kv2) * r
        exchange = me * cosine
        scale = 1 / (MASS * INERTIA - exchange * exchange)
        return (INERTIA * force - exchange * torque) * scale, (MASS * torque - exchange * force) * scale

    @numba.njit(fastmath=True, parallel=parallel)
    def simulate(x, start, current, shown):
        me, k, km, v, kv1, kv2 = x[0], x[1], x[2], x[3], x[4], x[5]
        h = STEP
        for n in experiments_of(current.shape[0]):
            q, w, p, r = start[n, 0], start[n, 1], start[n, 2], start[n, 3]
            for j in range(current.shape[1]):
                i = current[n, j]
                shown[n, 0, j], shown[n, 1, j] = q, r
                w1, r1 = rates(q, w, p, r, i, me, k, km, v, kv1, kv2)
                qb, pb = w + h / 2 * w1, r + h / 2 * r1
                w2, r2 = rates(q + h / 2 * w, qb, p + h / 2 * r, pb, i, me, k, km, v, kv1, kv2)
                qc, pc = w + h / 2 * w2, r + h / 2 * r2
                w3, r3 = rates(q + h / 2 * qb, qc, p + h / 2 * pb, pc, i, me, k, km, v, kv1, kv2)
                qd, pd = w + h * w3, r + h * r3
                w4, r4 = rates(q + h * qc, qd, p + h * pc, pd, i, me, k, km, v, kv1, kv2)
                q, p = q + h / 6 * (w + 2 * (qb + qc) + qd), p + h / 6 * (r + 2 * (pb + pc) + pd)
                w, r = w + h / 6 * (w1 + 2 * (w2 + w3) + w4), r + h / 6 * (r1 + 2 * (r2 + r3) + r4)

    return simulate


def scipy_over_numba(problem: Problem, starts: str, method: str = "trf") -> Fit:
    """Return SciPy's `least_squares` with its own differences over a simulator by Numba, on one core or on all, as is faster.

    What is known of an arm's angle that is set by hand counts as a measurement where starts are free, as in the package.
    """
    from scipy.optimize import least_squares

    from estimators.core.initial_state import ANGLE_SPREAD

    noise, begin, count = problem.noise[:, None], starts_of(problem, starts), len(NAMES)
    unused = np.empty_like(problem.measured)
    simulators = [_numba_simulator(parallel=parallel) for parallel in (False, True)]
    took = [best_of(3, lambda run=run: run(TRUE * OFF, begin, problem.current, unused)) for run in simulators]
    simulate = simulators[int(np.argmin(took))]
    size = np.tile([1e-3, 1e-2, 0.1, 1.0], len(begin))

    def residual(z: np.ndarray) -> np.ndarray:
        at, shown = begin, np.empty_like(problem.measured)
        if starts == "free":
            at = begin + (z[count:] * size).reshape(begin.shape)
        simulate(z[:count] * TRUE, at, problem.current, shown)
        error = ((problem.measured - shown) / noise).ravel()
        return error if starts != "free" else np.append(error, (at - begin)[:, 2] / ANGLE_SPREAD)

    first = OFF if starts != "free" else np.append(OFF, np.zeros(begin.size))

    def fit() -> tuple[np.ndarray, float]:
        found = least_squares(residual, first, method=method, x_scale="jac")
        return found.x[:count] * TRUE, float(np.sqrt(2 * found.cost / problem.measured.size))

    return fit


def optimistix_over_diffrax(problem: Problem, starts: str) -> Fit:
    """Return optimistix's Levenberg-Marquardt with forward derivatives through diffrax, experiments side by side."""
    import jax
    import jax.numpy as jnp
    import optimistix as optx
    from diffrax_runge_kutta import simulate

    from estimators.core.initial_state import ANGLE_SPREAD

    count = len(NAMES)
    size = jnp.asarray([1e-3, 1e-2, 0.1, 1.0])

    def rates(state: Any, current: Any, x: Any) -> Any:
        q, w, p, r = state
        me, k, km, v, kv1, kv2 = x
        force = -k * q - v * w + me * r * r * jnp.sin(p)
        torque = km * current - jnp.where(r > 0, kv1, kv2) * r
        exchange = me * jnp.cos(p)
        scale = 1 / (MASS * INERTIA - exchange * exchange)
        return jnp.stack(
            [w, (INERTIA * force - exchange * torque) * scale, r, (MASS * torque - exchange * force) * scale]
        )

    def residual(z: Any, data: Any) -> Any:
        begin, current, measured = data
        at = begin + z[1] * size if starts == "free" else begin
        x = z[0] * TRUE

        def one(start: Any, held: Any) -> Any:
            return simulate(lambda state, i: rates(state, i, x), start, held, STEP)[:, jnp.array([0, 3])].T

        error = (measured - jax.vmap(one)(at, current)) / problem.noise[:, None]
        return error, (at - begin)[:, 2] / ANGLE_SPREAD

    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    first = (jnp.asarray(OFF), jnp.zeros((len(problem.start), 4)) if starts == "free" else jnp.zeros(0))
    data = tuple(jnp.asarray(x) for x in (starts_of(problem, starts), problem.current, problem.measured))

    @jax.jit
    def solved(data: Any) -> Any:
        found = optx.least_squares(
            residual, solver, first, args=data, options={"jac": "fwd"}, max_steps=100, throw=False
        )
        error, angle = residual(found.value, data)
        return found.value[0], jnp.sum(error**2) + jnp.sum(angle**2)

    def fit() -> tuple[np.ndarray, float]:
        at, total = solved(data)
        return np.asarray(at)[:count] * TRUE, float(np.sqrt(total / problem.measured.size))

    return fit


TOOLS: dict[str, Callable[[Problem, str], Fit]] = {
    "package": package,
    "scipy_trf": scipy_over_numba,
    "scipy_lm": functools.partial(scipy_over_numba, method="lm"),
    "diffrax": optimistix_over_diffrax,
}
