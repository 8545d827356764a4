"""How fast the simulation is, as ratios to other ways of doing the same, all measured in one run on one machine.

    python benchmarks/bench_simulation.py [--trajectories 512] [--steps 2000] [--repeats 5]

Everyone integrates the same rig with the paper's friction: viscous and dry on the cart, viscous by direction on the arm,
the current held over a step of 2 ms. The simulation of the package cuts a step where the cart comes to rest; the others
take the smooth sign x / sqrt(x^2 + s^2). Peers that are not installed are left out.
"""

import argparse
import os
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import rtac_jax as rtac

STEP = 2e-3  # s
SMOOTH_CART, SMOOTH_ARM = 1e-3, 0.1  # m/s and rad/s, where the smooth sign turns
M, K, V, D, ME, J, KM, KV1, KV2 = 1.23, 132.6, 0.5543, 0.024, 1.06e-3, 9.5e-5, 0.0804, 1.39e-4, 1.49e-4
BENCH = Path(__file__).parents[2] / "shared" / "bench"

Row = tuple[str, int, float]
"""What was run, how many trajectories at once, and ns per step and trajectory."""


def best_of(repeats: int, work: Callable[[], object]) -> float:
    """Shortest wall time [s] of several runs after one that compiles."""
    work()
    found = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        found.append(time.perf_counter() - began)
    return min(found)


def currents(steps: int, trajectories: int) -> np.ndarray:
    """Held currents [A], (steps, trajectories)."""
    return 0.34 * (np.random.default_rng(0).random((steps, trajectories)) - 0.5)


def package(trajectories: int, steps: int, repeats: int, *, dry: bool) -> tuple[Row, np.ndarray]:
    """The time loop that every estimator runs; with the final cart positions."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    from rtac_jax.simulation import trajectories as loop

    model = rtac.RTAC.paper() if dry else rtac.RTAC.paper().without("cart_coulomb")
    unused = np.linspace(0.0, 1e-3, steps)  # an experiment has outputs; they are not looked at
    experiments = [
        rtac.Experiment.of(f"e{n}", kind="forced", sample_time=STEP, current=column, cart_position=unused)
        for n, column in enumerate(currents(steps, trajectories).T)
    ]
    excitation = rtac.Excitation.of(experiments)
    start = tuple(jnp.full(trajectories, x) for x in (0.02, 0.0, 0.0, 0.0))
    run = eqx.filter_jit(lambda m, s, e: loop(m, s, e, samples=steps, substeps=jnp.asarray(1)))
    seconds = best_of(repeats, lambda: jax.block_until_ready(run(model, start, excitation)))
    name = "rtac_jax, dry friction" if dry else "rtac_jax, viscous friction only"
    return (name, trajectories, 1e9 * seconds / steps / trajectories), np.asarray(run(model, start, excitation))[-1, 0]


def slope(_t, x, current):
    """Equations (1) and (2), written again."""
    q, dq, angle, rate = x
    sine, cosine = np.sin(angle), np.cos(angle)
    sign = dq / np.sqrt(dq * dq + SMOOTH_CART * SMOOTH_CART)
    share = 0.5 * (1 + rate / np.sqrt(rate * rate + SMOOTH_ARM * SMOOTH_ARM))
    torque = KM * current - (KV2 + (KV1 - KV2) * share) * rate
    force = -K * q - V * dq - D * sign + ME * rate * rate * sine
    exchange = ME * cosine
    scale = 1 / (M * J - exchange * exchange)
    return (dq, (J * force - exchange * torque) * scale, rate, (M * torque - exchange * force) * scale)


def scipy_single(steps: int, repeats: int) -> Row:
    """`solve_ivp` (RK45), restarted at each sample, as a held current asks for."""
    from scipy.integrate import solve_ivp

    held = currents(steps, 1)[:, 0]

    def work() -> None:
        at = np.array([0.02, 0.0, 0.0, 0.0])
        for current in held:
            at = solve_ivp(slope, (0.0, STEP), at, args=(current,), first_step=STEP, rtol=1e-4, atol=1e-8).y[:, -1]

    return "SciPy solve_ivp", 1, 1e9 * best_of(repeats, work) / steps


def numpy_batch(trajectories: int, steps: int, repeats: int) -> Row:
    """Classic Runge-Kutta in NumPy, all trajectories at once."""
    held = currents(steps, trajectories)

    def work() -> None:
        at = np.zeros((4, trajectories))
        at[0] = 0.02
        for current in held:
            a = np.array(slope(0.0, at, current))
            b = np.array(slope(0.0, at + STEP / 2 * a, current))
            c = np.array(slope(0.0, at + STEP / 2 * b, current))
            d = np.array(slope(0.0, at + STEP * c, current))
            at = at + STEP / 6 * (a + 2 * b + 2 * c + d)

    return "NumPy RK4", trajectories, 1e9 * best_of(repeats, work) / steps / trajectories


def numba_rows(trajectories: int, steps: int, repeats: int) -> tuple[list[Row], np.ndarray | None]:
    """The same Runge-Kutta compiled by Numba, one trajectory after another; with the final cart positions."""
    try:
        import numba
    except ImportError:
        return [], None
    derivative = numba.njit(fastmath=True)(slope)

    @numba.njit(fastmath=True)
    def integrate(held, shown):
        for n in range(held.shape[1]):
            q, w, p, r = 0.02, 0.0, 0.0, 0.0
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

    rows: list[Row] = []
    shown = np.empty((steps, 2, 1))
    for count in (1, trajectories):
        held = currents(steps, count)
        shown = np.empty((steps, 2, count))
        seconds = best_of(repeats, lambda held=held, shown=shown: integrate(held, shown))
        rows.append(("Numba RK4", count, 1e9 * seconds / steps / count))
    return rows, shown[-1, 0]


def c_rows() -> list[Row]:
    """The hand-written C programs beside the project, where there are a compiler and they."""
    compiler = shutil.which("gcc")
    if compiler is None or not BENCH.is_dir():
        return []
    rows = []
    cases = (("rk4_scalar", ["-lm"], 1), ("rk4_limit", ["-DALG", "-lmvec", "-lm"], 512))
    with tempfile.TemporaryDirectory() as folder:
        for name, options, count in cases:
            program = str(Path(folder) / name)
            command = [
                compiler,
                "-O3",
                "-march=native",
                "-ffast-math",
                "-o",
                program,
                str(BENCH / f"{name}.c"),
                *options,
            ]
            try:
                subprocess.run(command, check=True, capture_output=True)
                said = subprocess.run([program], check=True, capture_output=True, text=True).stdout
            except (OSError, subprocess.CalledProcessError):
                continue  # another processor or C library
            rows.append(("C RK4, the floor", count, min(float(x) for x in re.findall(r"([\d.]+) ns", said))))
    return rows


def table(rows: list[Row]) -> str:
    """Nanoseconds and ratios to the package's row of the same number of trajectories with dry friction."""
    own = {count: ns for name, count, ns in rows if name == "rtac_jax, dry friction"}
    lines = [f"{'':34s} {'trajectories':>12s} {'ns per step':>12s} {'time / rtac_jax':>16s}"]
    lines.append(f"{'':34s} {'at once':>12s} {'and traj.':>12s} {'same number':>16s}")
    for name, count, ns in sorted(rows, key=lambda row: (row[1], row[2])):
        lines.append(f"{name:34s} {count:12d} {ns:12.1f} {ns / own[count] if count in own else np.nan:16.2f}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trajectories", type=int, default=512)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--repeats", type=int, default=5)
    chosen = parser.parse_args()
    count, steps, repeats = chosen.trajectories, chosen.steps, chosen.repeats
    print(rtac.configure())
    rows: list[Row] = []
    end = np.zeros(1)
    for n in (1, count):
        for dry in (True, False):
            row, found = package(n, steps, repeats, dry=dry)
            rows.append(row)
            end = found if dry else end
    rows += [scipy_single(min(steps, 500), 1), numpy_batch(count, steps, 1)]
    compiled, other = numba_rows(count, steps, repeats)
    rows += compiled + c_rows()
    print(
        f"{steps} steps of {1e3 * STEP:g} ms; load of the machine {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores\n"
    )
    print(table(rows))
    if other is not None:
        print(f"\nlargest difference of the cart's end position from Numba's: {1e6 * np.abs(end - other).max():.2g} µm")
    missing = {"Numba RK4", "C RK4, the floor"} - {name for name, _, _ in rows}
    if missing:
        print("not here: " + ", ".join(sorted(missing)))


if __name__ == "__main__":
    main()
