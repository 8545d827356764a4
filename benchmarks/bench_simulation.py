"""How fast the simulation is, as ratios to other ways of doing the same, all measured in one run on one machine.

    python benchmarks/bench_simulation.py [--trajectories 512] [--steps 2000] [--single 10000] [--repeats 20]

Everyone integrates the same rig with the paper's friction: viscous and dry on the cart, viscous by direction on the arm,
the current held over a step of 2 ms. The simulation of the package cuts a step where the cart comes to rest; the others
take the smooth sign x / sqrt(x^2 + s^2). Peers that are not installed are left out. One trajectory is of more steps than a batch,
as many as the C program takes.
"""

from typing import Any, NamedTuple

import numpy as np
from measuring import best_of, hand_back, load, parser
from rig_equations import START, STEP, currents
from simulation_peers import C, Row, of_c, of_diffrax, of_numba, of_numpy, of_scan, of_scipy

import rtac_jax as rtac

OWN = "rtac_jax, dry friction"


class Cost(NamedTuple):
    """What XLA makes of a step of the time loop, by its own account."""

    trajectories: int
    kernels: int
    """Loops over all trajectories that are called one after the other."""
    operations: float
    """Of floating point, for each trajectory."""
    bytes: float
    """Read and written by these kernels, for each trajectory."""


def time_loop(trajectories: int, steps: int, *, dry: bool) -> tuple[Any, tuple[Any, ...]]:
    """The compiled time loop that every estimator runs, and what it is called with."""
    import equinox as eqx
    import jax.numpy as jnp

    from rtac_jax.simulation import trajectories as loop

    model = rtac.RTAC.paper() if dry else rtac.RTAC.paper().without("cart_coulomb")
    unused = np.linspace(0.0, 1e-3, steps)  # an experiment has outputs; they are not looked at
    experiments = [
        rtac.Experiment.of(f"e{n}", kind="forced", sample_time=STEP, current=column, cart_position=unused)
        for n, column in enumerate(currents(steps, trajectories).T)
    ]
    excitation = rtac.Excitation.of(experiments)
    start = tuple(jnp.full(trajectories, x) for x in START)
    run = eqx.filter_jit(lambda m, s, e: loop(m, s, e, samples=steps, substeps=jnp.asarray(1)))
    return run, (model, start, excitation)


def compiled_loop(trajectories: int, steps: int, repeats: int, *, dry: bool) -> tuple[Row, np.ndarray]:
    """The time loop by itself; with the final cart positions."""
    import jax

    run, given = time_loop(trajectories, steps, dry=dry)
    seconds = best_of(repeats, lambda: jax.block_until_ready(run(*given)))
    name = OWN if dry else "rtac_jax, viscous friction only"
    return Row(name, trajectories, 1e9 * seconds / steps / trajectories), np.asarray(run(*given))[-1, 0]


def cost_of_step(trajectories: int) -> Cost:
    """Return what a step costs by XLA's account, which counts the body of a loop once.

    What is around the loop goes with the room for samples, and is taken off. With so many the stages of a step are compiled one by
    one, so that all of them count.
    """
    from rtac_jax.simulation import UNROLLED

    rooms, room = [], -(-UNROLLED // trajectories)
    for samples in (room, 2 * room):
        run, given = time_loop(trajectories, samples, dry=True)
        rooms.append(run.lower(*given).compile().compiled)
    kernels = max(part.count(" fusion(") + part.count(" copy(") for part in rooms[0].as_text().split("\n\n"))
    less, more = (made.cost_analysis() for made in rooms)
    counted = [round((2 * less[n] - more[n]) / trajectories, 1) for n in ("flops", "bytes accessed")]
    return Cost(trajectories, kernels, *counted)


def public_calls(trajectories: int, steps: int, single: int, repeats: int) -> list[Row]:
    """`rtac.simulate_inputs` as a user calls it: one trajectory, and a batch over currents by `vmap`."""
    import jax

    model = rtac.RTAC.paper()
    one, several = currents(single, 1)[:, 0], currents(steps, trajectories).T

    def position(held):
        return rtac.simulate_inputs(model, current=held, sample_time=STEP, start=START, substeps=1).cart_position

    call, batch = best_of(repeats, lambda: position(one)), jax.jit(jax.vmap(position))
    together = best_of(repeats, lambda: jax.block_until_ready(batch(several)))
    return [
        Row("rtac.simulate_inputs, the whole call", 1, 1e9 * call / single),
        Row("rtac.simulate_inputs under jit and vmap", trajectories, 1e9 * together / steps / trajectories),
    ]


def table(rows: list[Row]) -> str:
    """Nanoseconds and ratios to the package's row of the same number of trajectories with dry friction."""
    own = {row.trajectories: row.nanoseconds for row in rows if row.name == OWN}
    lines = [f"{'':40s} {'trajectories':>12s} {'ns per step':>12s} {'time / rtac_jax':>16s}"]
    lines.append(f"{'':40s} {'at once':>12s} {'and traj.':>12s} {'same number':>16s}")
    for name, count, ns in sorted(rows, key=lambda row: (row.trajectories, row.nanoseconds)):
        lines.append(f"{name:40s} {count:12d} {ns:12.1f} {ns / own[count] if count in own else np.nan:16.2f}")
    return "\n".join(lines)


def ratios(rows: list[Row]) -> dict[str, float]:
    """Time of the package over that of C, where C ran."""
    at = {(row.name, row.trajectories): row.nanoseconds for row in rows}
    calls = {"batch_512": (OWN, 512), "single": (OWN, 1), "single_call": ("rtac.simulate_inputs, the whole call", 1)}
    return {
        f"{name}_vs_c": round(at[row] / at[C, row[1]], 3)
        for name, row in calls.items()
        if row in at and (C, row[1]) in at
    }


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--trajectories", type=int, default=512)
    made.add_argument("--steps", type=int, default=2000)
    made.add_argument("--single", type=int, default=10000, help="steps of one trajectory")
    made.add_argument("--repeats", type=int, default=20)
    chosen = made.parse_args()
    count, repeats = chosen.trajectories, chosen.repeats
    repeats = 3 if chosen.small else repeats
    steps, single = (100, 200) if chosen.small else (chosen.steps, chosen.single)
    print(rtac.configure())
    rows: list[Row] = []
    costs = [cost_of_step(n) for n in (1, count)]
    end = np.zeros(1)
    for n, length in ((1, single), (count, steps)):
        for dry in (True, False):
            row, found = compiled_loop(n, length, repeats, dry=dry)
            rows.append(row)
            end = found if dry else end
    # C first: whoever else uses the machine meanwhile should meet both alike.
    rows += of_c()
    rows += [*public_calls(count, steps, single, repeats), of_scipy(min(steps, 500)), of_numpy(count, steps)]
    ends = {}
    for peer in (of_scan, of_numba, of_diffrax):
        for n, length in ((1, single), (count, steps)):
            if (made_by := peer(n, length, repeats)) is not None:
                rows.append(made_by[0])
                ends[made_by[0].name] = made_by[1]
    print(f"{steps} steps of {1e3 * STEP:g} ms, of one trajectory {single}; load of the machine {load()}\n")
    print(table(rows))
    for cost in costs:
        print(
            f"a step of {cost.trajectories} at once: {cost.kernels} kernels, and for each trajectory {cost.operations:.0f} "
            f"operations and {cost.bytes:.0f} bytes between memory and registers"
        )
    for name, other in ends.items():
        print(f"largest difference of the cart's end position from {name}'s: {1e6 * np.abs(end - other).max():.2g} µm")
    missing = {"Numba RK4", "diffrax RK4", C} - {row.name for row in rows}
    if missing:
        print("not here: " + ", ".join(sorted(missing)))
    of_loop = [cost._asdict() for cost in costs]
    hand_back(chosen, {"ratios": ratios(rows), "rows": [row._asdict() for row in rows], "a_step": of_loop})


if __name__ == "__main__":
    main()
