"""What derivatives cost beside the simulation that they are of.

    python benchmarks/bench_jacobian.py [--experiments 18] [--samples 5000] [--repeats 5]

Of the estimator: residual and Jacobian of all experiments, by seven parameters and the four states at the start, compressed to
triangular factors as a fit takes them, over the residual alone. Of the public simulation of one experiment: `jax.jacfwd` and
`jax.grad` by six parameters over the simulation, all compiled.
"""

import argparse

import numpy as np
from measuring import Found, best_of, hand_back, parser
from same_problem import NAMES, STEP, TRUE, problem

import rtac_jax as rtac


def of_estimator(chosen: argparse.Namespace) -> tuple[dict[str, float], int]:
    """Seconds of the residual, and of the residual with its Jacobian; and the number of directions."""
    import jax

    from estimators.core.data import CHANNELS, Data, moving, pieces
    from estimators.core.initial_state import space_of
    from estimators.core.jacobian_factor import Arguments, factor, plain_residual
    from estimators.core.residual import diagonal_whitener, no_gain

    recording = problem(chosen.experiments, chosen.samples).recording
    model, experiments = rtac.RTAC.from_rig(recording), pieces(moving(recording))
    data = Data.of(experiments)
    space = space_of(model, experiments, free=model.free)
    whitener = diagonal_whitener(np.ones(len(CHANNELS)), data)
    arguments = Arguments(model, data, space, whitener, no_gain(model, data), 1)
    unknowns = space.unconstrained()
    found = {
        "residual": best_of(chosen.repeats, lambda: jax.block_until_ready(plain_residual(unknowns, arguments))),
        "residual and Jacobian": best_of(chosen.repeats, lambda: jax.block_until_ready(factor(unknowns, arguments))),
    }
    return found, len(unknowns.shared) + len(unknowns.start)


def of_public_simulation(samples: int, repeats: int) -> dict[str, float]:
    """Seconds of one experiment, of its Jacobian by forward mode, and of the gradient of a sum of squares by reverse mode."""
    import jax
    import jax.numpy as jnp

    model, current = rtac.RTAC.paper(), 0.1 * np.sin(0.05 * np.arange(samples))

    def position(values):
        there = model.with_values(dict(zip(NAMES, values, strict=True)))
        start = (0.01, 0.0, 0.0, 0.0)
        return rtac.simulate_inputs(there, current=current, sample_time=STEP, start=start, substeps=1).cart_position

    works = {
        "simulate_inputs": jax.jit(position),
        "jacfwd": jax.jit(jax.jacfwd(position)),
        "grad": jax.jit(jax.grad(lambda values: jnp.sum(position(values) ** 2))),
    }
    at = jnp.asarray(TRUE)
    return {name: best_of(repeats, lambda f=f: jax.block_until_ready(f(at))) for name, f in works.items()}


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--experiments", type=int, default=18)
    made.add_argument("--samples", type=int, default=5000)
    made.add_argument("--repeats", type=int, default=5)
    chosen = made.parse_args()
    if chosen.small:
        chosen.experiments, chosen.samples, chosen.repeats = 3, 200, 2
    rtac.configure()
    estimator, directions = of_estimator(chosen)
    public = of_public_simulation(chosen.samples, chosen.repeats)
    ratio = estimator["residual and Jacobian"] / estimator["residual"]
    count = chosen.experiments * chosen.samples
    print(f"{chosen.experiments} experiments x {chosen.samples} samples, {directions} directions")
    for name, seconds in estimator.items():
        print(f"{name:34s} {1e3 * seconds:10.1f} ms {1e9 * seconds / count:10.1f} ns per sample")
    print(f"{'with over without Jacobian':34s} {ratio:10.2f}, {ratio / directions:.2f} for each direction\n")
    print(f"one experiment of {chosen.samples} samples, six parameters")
    for name, seconds in public.items():
        print(f"{name:34s} {1e3 * seconds:10.1f} ms {seconds / public['simulate_inputs']:10.2f} simulations")
    found: Found = {
        "ratios": {
            "jacobian_vs_simulation": round(ratio, 3),
            "jacfwd_vs_simulation": round(public["jacfwd"] / public["simulate_inputs"], 3),
            "grad_vs_simulation": round(public["grad"] / public["simulate_inputs"], 3),
        },
        "rows": {"directions": directions, "estimator": estimator, "public": public},
    }
    hand_back(chosen, found)


if __name__ == "__main__":
    main()
