"""Other ways to simulate the rig: C by hand, Numba, NumPy, SciPy and diffrax; what is not installed is left out."""

import importlib.util
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measuring import best_of
from rig_equations import KM, KV1, KV2, ME, SMOOTH_ARM, SMOOTH_CART, START, STEP, D, J, K, M, V, currents, slope

FLOOR = Path(__file__).parent / "floor" / "rk4.c"
C = "C by hand, the floor"


class Row(NamedTuple):
    """What was run, how many trajectories at once, and ns per step and trajectory."""

    name: str
    trajectories: int
    nanoseconds: float


def lanes() -> int:
    """Return how many doubles a vector of this processor holds: of AVX-512, AVX2, or else of SSE2, which every x86-64 has."""
    cpuinfo = Path("/proc/cpuinfo")
    known = cpuinfo.read_text().split() if cpuinfo.exists() else []
    return next((count for flag, count in (("avx512f", 8), ("avx2", 4)) if flag in known), 2)


def of_c() -> list[Row]:
    """Run the hand-written program of `floor/`, where there is a compiler: one trajectory and 512 in vectors, the best of 20."""
    compiler = shutil.which("gcc")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for options, count in (("-DLANES=1 -lm", 1), (f"-DLANES={lanes()} -lmvec -lm", 512)):
            program = str(Path(folder) / f"rk4_{count}")
            command = [
                str(compiler),
                "-O3",
                "-march=native",
                "-ffast-math",
                "-o",
                program,
                str(FLOOR),
                *options.split(),
            ]
            try:
                subprocess.run(command, check=True, capture_output=True)
                runs = [subprocess.run([program], check=True, capture_output=True, text=True) for _ in range(4)]
            except (OSError, subprocess.CalledProcessError):
                continue  # no compiler, another processor or C library
            rows.append(Row(C, count, min(float(run.stdout.split()[0]) for run in runs)))
    return rows


def of_scipy(steps: int) -> Row:
    """`solve_ivp` (RK45), restarted at each sample, as a held current asks for."""
    from scipy.integrate import solve_ivp

    held = currents(steps, 1)[:, 0]

    def work() -> None:
        at = np.array(START)
        for current in held:
            at = solve_ivp(slope, (0.0, STEP), at, args=(current,), first_step=STEP, rtol=1e-4, atol=1e-8).y[:, -1]

    return Row("SciPy solve_ivp", 1, 1e9 * best_of(1, work) / steps)


def of_numpy(trajectories: int, steps: int) -> Row:
    """Classic Runge-Kutta in NumPy, all trajectories at once."""
    held = currents(steps, trajectories)

    def work() -> None:
        at = np.zeros((4, trajectories))
        at[0] = START[0]
        for current in held:
            a = np.array(slope(0.0, at, current))
            b = np.array(slope(0.0, at + STEP / 2 * a, current))
            c = np.array(slope(0.0, at + STEP / 2 * b, current))
            d = np.array(slope(0.0, at + STEP * c, current))
            at = at + STEP / 6 * (a + 2 * b + 2 * c + d)

    return Row("NumPy RK4", trajectories, 1e9 * best_of(1, work) / steps / trajectories)


def of_numba(trajectories: int, steps: int, repeats: int) -> tuple[Row, np.ndarray] | None:
    """The same Runge-Kutta compiled by Numba, one trajectory after another; with the final cart positions."""
    if importlib.util.find_spec("numba") is None:
        return None
    import numba

    derivative = numba.njit(fastmath=True)(slope)

    @numba.njit(fastmath=True)
    def integrate(held, shown):
        for n in range(held.shape[1]):
            q, w, p, r = START
            for k in range(held.shape[0]):
                i, h = held[k, n], STEP
                shown[k, 0, n], shown[k, 1, n] = q, r
                a = derivative(0.0, (q, w, p, r), i)
                b = derivative(0.0, (q + h / 2 * a[0], w + h / 2 * a[1], p + h / 2 * a[2], r + h / 2 * a[3]), i)
                c = derivative(0.0, (q + h / 2 * b[0], w + h / 2 * b[1], p + h / 2 * b[2], r + h / 2 * b[3]), i)
                d = derivative(0.0, (q + h * c[0], w + h * c[1], p + h * c[2], r + h * c[3]), i)
                q += h / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
                w += h / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
                p += h / 6 * (a[2] + 2 * b[2] + 2 * c[2] + d[2])
                r += h / 6 * (a[3] + 2 * b[3] + 2 * c[3] + d[3])

    held, shown = currents(steps, trajectories), np.empty((steps, 2, trajectories))
    seconds = best_of(repeats, lambda: integrate(held, shown))
    return Row("Numba RK4", trajectories, 1e9 * seconds / steps / trajectories), shown[-1, 0]


def _stacked_slope(state: Any, current: Any) -> Any:
    """`slope` for JAX, the state as one vector."""
    import jax.numpy as jnp

    q, dq, angle, rate = state
    sign = dq / jnp.sqrt(dq * dq + SMOOTH_CART**2)
    share = 0.5 * (1 + rate / jnp.sqrt(rate * rate + SMOOTH_ARM**2))
    torque = KM * current - (KV2 + (KV1 - KV2) * share) * rate
    force = -K * q - V * dq - D * sign + ME * rate * rate * jnp.sin(angle)
    exchange = ME * jnp.cos(angle)
    scale = 1 / (M * J - exchange * exchange)
    return jnp.stack([dq, (J * force - exchange * torque) * scale, rate, (M * torque - exchange * force) * scale])


def of_scan(trajectories: int, steps: int, repeats: int) -> tuple[Row, np.ndarray]:
    """The same Runge-Kutta as a bare `jax.lax.scan` of a vector of four states: what XLA can do with one trajectory."""
    import jax
    import jax.numpy as jnp

    def step(at: Any, i: Any) -> tuple[Any, Any]:
        a = _stacked_slope(at, i)
        b = _stacked_slope(at + STEP / 2 * a, i)
        c = _stacked_slope(at + STEP / 2 * b, i)
        d = _stacked_slope(at + STEP * c, i)
        return at + STEP / 6 * (a + 2 * b + 2 * c + d), at[jnp.array([0, 3])]

    run = jax.jit(jax.vmap(lambda held: jax.lax.scan(step, jnp.asarray(START), held)[1]))
    held = jnp.asarray(currents(steps, trajectories).T)
    seconds = best_of(repeats, lambda: jax.block_until_ready(run(held)))
    return Row("a bare jax.lax.scan", trajectories, 1e9 * seconds / steps / trajectories), np.asarray(run(held))[
        :, -1, 0
    ]


def of_diffrax(trajectories: int, steps: int, repeats: int) -> tuple[Row, np.ndarray] | None:
    """diffrax by the same Runge-Kutta steps, trajectories side by side by `vmap`; with the final cart positions."""
    if importlib.util.find_spec("diffrax") is None:
        return None
    import jax
    import jax.numpy as jnp
    from diffrax_runge_kutta import simulate

    run = jax.jit(jax.vmap(lambda held: simulate(_stacked_slope, jnp.asarray(START), held, STEP)))
    held = jnp.asarray(currents(steps, trajectories).T)
    seconds = best_of(repeats, lambda: jax.block_until_ready(run(held)))
    return Row("diffrax RK4", trajectories, 1e9 * seconds / steps / trajectories), np.asarray(run(held))[:, -1, 0]
