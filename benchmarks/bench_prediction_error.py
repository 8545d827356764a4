"""How fast linear models of many conditions are fitted at once, beside one call for each, in one run on one machine.

    python benchmarks/bench_prediction_error.py [--conditions 20] [--samples 5000] [--repeats 3]

Both are timed after everything has been compiled, and end in the same parameters; how far they differ is printed. The loop is
timed twice: as calls of `prediction_error`, and as calls of the compiled fit alone, without search for a start, residual
tests and covariances. With --optimistix the same fit is done by optimistix's LevenbergMarquardt under vmap.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.signal
from measuring import Found, hand_back, once, parser

import estimators as est
import rtac_jax as rtac
from rtac_jax.measurement import Experiment, Recording

STEP = 0.01  # s


def best_of(repeats: int, work: Callable[[], Any]) -> tuple[float, Any]:
    """Shortest wall time [s] of several runs after one that compiles, and what the last one returned."""
    work()
    runs = [once(work) for _ in range(repeats)]
    return min(seconds for seconds, _ in runs), runs[-1][1]


def conditions(count: int, samples: int) -> Recording:
    """One resonance with coloured noise, simulated here."""
    random = np.random.default_rng(0)
    a, b, c, _, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss([2.0, 30.0], [1.0, 1.6, 110.0]), STEP)
    current = random.standard_normal((count, samples))
    state, out = np.zeros((count, 2)), np.empty((count, samples))
    for n in range(samples):
        out[:, n] = state @ c[0]
        state = state @ a.T + current[:, n : n + 1] * b[:, 0]
    noise = scipy.signal.lfilter([1.0, 0.5, 0.3], [1.0, -1.4, 0.6], 0.03 * random.standard_normal(out.shape), axis=1)
    return Recording(
        tuple(
            Experiment.of(f"run_{i}", kind="forced", sample_time=STEP, current=u, cart_position=y)
            for i, (u, y) in enumerate(zip(current, out + noise, strict=True))
        )
    )


def compiled(structure: str, data: Recording, repeats: int, *, optimistix: bool) -> tuple[float, float, float]:
    """Seconds of the compiled fit of all at once, of a loop over them, and, if asked for, of optimistix for all at once."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import optimistix as optx

    from estimators.linear.fit import structure_of
    from estimators.linear.operating_conditions import conditions as signals
    from estimators.linear.operating_conditions import stacked
    from estimators.linear.predictor import prediction_errors, solve
    from estimators.linear.stages import predictor_stage, simulation_stages

    options: dict[str, Any] = {
        "input": "current", "output": "cart_position", "compensate": False, "detrend": False, "angles": None, "model": None,
    }  # fmt: skip
    _, raw, _, present = signals(data, **options)
    kind = structure_of(structure, 1, None, None)
    stage = predictor_stage(kind, next(simulation_stages(kind, stacked(raw, present), raw, [], 1)))
    # From poles and residues off by two and five percent.
    begin = stage.theta + 0.02
    begin[:, 2:4] *= 1.05
    batch, _ = best_of(repeats, lambda: solve(kind, begin, stage.data))

    def loop() -> None:
        for i in range(len(raw)):
            solve(kind, begin[i : i + 1], jax.tree.map(lambda x, i=i: x[i : i + 1], stage.data))

    looped, _ = best_of(repeats, loop)
    if not optimistix:
        return batch, looped, np.nan

    @eqx.filter_jit
    def by_optimistix(theta: Any, signals: Any) -> Any:
        def one(at: Any, of: Any) -> Any:
            return optx.least_squares(
                lambda t, s: prediction_errors(kind, t, s), optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8), at, args=of,
                max_steps=100, throw=False, options={"jac": "fwd"},
            ).value  # fmt: skip

        return jax.vmap(one)(theta, signals)

    other, _ = best_of(repeats, lambda: jax.block_until_ready(by_optimistix(jnp.asarray(begin), stage.data)))
    return batch, looped, other


def main() -> None:
    """Print the table."""
    made = parser(__doc__)
    made.add_argument("--conditions", type=int, default=20)
    made.add_argument("--samples", type=int, default=5000)
    made.add_argument("--repeats", type=int, default=3)
    made.add_argument("--optimistix", action="store_true")
    chosen = made.parse_args()
    if chosen.small:
        chosen.conditions, chosen.samples, chosen.repeats = 3, 500, 1
    rtac.configure()
    rows: list[dict[str, Any]] = []
    data = conditions(chosen.conditions, chosen.samples)
    print(f"{chosen.conditions} conditions of {chosen.samples} samples; seconds, after compilation")
    print(f"{'':14s} {'':>12s} {'at once':>9s} {'loop':>9s} {'ratio':>6s} {'difference':>11s} {'optimistix':>11s}")
    for structure in ("output_error", "armax", "box_jenkins", "state_space"):
        batch, together = best_of(
            chosen.repeats,
            lambda s=structure: est.prediction_error(data, structure=s, compensate=False, progress=False),
        )

        def loop(structure: str = structure) -> list[Any]:
            return [
                est.prediction_error(data.select([n]), structure=structure, compensate=False, progress=False)[0]
                for n in data.names
            ]

        looped, alone = best_of(1, loop)  # it takes most of the section
        away = max(float(np.max(np.abs(a.values / b.values - 1))) for a, b in zip(together, alone, strict=True))
        print(f"{structure:14s} {'whole call':>12s} {batch:9.3f} {looped:9.3f} {looped / batch:6.1f} {away:11.1e}")
        rows.append({"structure": structure, "batch": batch, "loop": looped, "difference": away})
        batch, looped, other = compiled(structure, data, chosen.repeats, optimistix=chosen.optimistix)
        print(f"{'':14s} {'fit alone':>12s} {batch:9.3f} {looped:9.3f} {looped / batch:6.1f} {'':11s} {other:11.3f}")
        rows[-1] |= {"fit_batch": batch, "fit_loop": looped}
    found: Found = {"rows": rows}
    hand_back(chosen, found)


if __name__ == "__main__":
    main()
