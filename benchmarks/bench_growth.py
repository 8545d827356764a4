"""How the time of a fit grows with samples, experiments, parameters and effects.

    python benchmarks/bench_growth.py

Around 6 experiments of 1,000 samples with seven parameters one of these is changed at a time. Cold is the first fit of a process
with an empty folder of compiled code, warm the same fit once more; each size is a process of its own. Fits begin at the model's
values, so that all of them take about as many steps. A step is the time of one residual with its Jacobian.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from measuring import Found, best_of, hand_back, once, parser, peak_megabytes

import rtac_jax as rtac
from rtac_jax import virtual_rig

STEP = 2e-3  # s
BASE = {"samples": 1000, "experiments": 6, "parameters": 7, "effects": 0}
SIZES = {
    "samples": (1000, 5000, 25000),
    "experiments": (6, 18, 54),
    "parameters": (2, 4, 7),
    "effects": (0, 2, 4),
}  # fmt: skip
SMALL = {"samples": (100, 400)}
# The first so many of these are free. Nine, with mass and inertia, no recording determines: only their ratios show.
PARAMETERS = (
    "spring_stiffness", "cart_viscous.coefficient", "eccentric_moment", "torque_constant", "arm_viscous.positive",
    "arm_viscous.negative", "cart_coulomb.level",
)  # fmt: skip


def measured(samples: int, experiments: int, parameters: int, effects: int) -> dict[str, float]:
    """Fit in this process: seconds cold, warm and of a step, the number of steps, and the largest memory."""
    import jax

    import estimators as est
    from estimators.core.data import CHANNELS, Data, moving, pieces
    from estimators.core.initial_state import space_of
    from estimators.core.jacobian_factor import Arguments, factor
    from estimators.core.residual import diagonal_whitener, no_gain

    rtac.configure()
    free = experiments // 3
    plans = virtual_rig.standard_plans(
        seed=1, sample_time=STEP, duration=STEP * samples, free=free, forced=experiments - free, rest=1
    )
    rig = virtual_rig.Rig(cubic_spring=5e4, cart_quadratic_drag=0.5, arm_coulomb=2e-4, arm_quadratic_drag=1e-5)
    recording = virtual_rig.record(rig, plans, seed=1)
    model = rtac.RTAC.from_rig(recording)
    model = model.fix(*model.free).release(*PARAMETERS[:parameters])
    kinds = (
        rtac.effects.CubicSpring(4e4), rtac.effects.CartQuadraticDrag(0.4), rtac.effects.ArmCoulomb(1e-4),
        rtac.effects.ArmQuadraticDrag(1e-5),
    )  # fmt: skip
    for effect in kinds[:effects]:
        model = model + effect

    def fit():
        return est.output_error(model, recording, from_model=True, progress=False)

    cold, found = once(fit)
    warm, found = once(fit)
    whole, data = pieces(moving(recording)), Data.of(pieces(moving(recording)))
    space = space_of(model, whole, free=model.free)
    arguments = Arguments(
        model, data, space, diagonal_whitener(np.ones(len(CHANNELS)), data), no_gain(model, data),
        found.statistics["substeps"],
    )  # fmt: skip
    unknowns = space.unconstrained()
    return {
        "cold": cold, "warm": warm, "steps": found.statistics["steps"],
        "step": best_of(3, lambda: jax.block_until_ready(factor(unknowns, arguments))), "megabytes": peak_megabytes(),
    }  # fmt: skip


def in_a_child(size: dict[str, int]) -> dict[str, float]:
    """Measure in a process of its own, with an empty folder of compiled code."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "found.json"
        command = [sys.executable, __file__, "--json", str(answer), "--one", *(str(size[n]) for n in BASE)]
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(Path(folder) / "cache")}
        subprocess.run(command, check=True, env=environment)
        return json.loads(answer.read_text())


def main() -> None:
    made = parser(__doc__)
    made.add_argument(
        "--one", nargs=4, type=int, metavar=tuple(n.upper() for n in BASE), help="measure in this process"
    )
    chosen = made.parse_args()
    if chosen.one:
        return hand_back(chosen, measured(*chosen.one))
    print(f"{'':14s} {'':>8s} {'cold [s]':>9s} {'warm [s]':>9s} {'steps':>6s} {'step [ms]':>10s} {'memory [MiB]':>13s}")
    rows: list[dict[str, float | str]] = []
    done: dict[tuple[int, ...], dict[str, float]] = {}
    for changed, sizes in (SMALL if chosen.small else SIZES).items():
        for size in sizes:
            at = BASE | ({"experiments": 2} if chosen.small else {}) | {changed: size}
            key = tuple(at.values())
            done[key] = found = done[key] if key in done else in_a_child(at)
            rows.append({"changed": changed, "size": size} | found)
            print(
                f"{changed:14s} {size:8d} {found['cold']:9.1f} {found['warm']:9.2f} {found['steps']:6.0f} "
                f"{1e3 * found['step']:10.1f} {found['megabytes']:13.0f}", flush=True,
            )  # fmt: skip
    found: Found = {"rows": rows}
    return hand_back(chosen, found)


if __name__ == "__main__":
    main()
