"""The envelope's weight beside that of dkpy, on the same profiles: mean and largest excess over the profile, and the time.

    python benchmarks/bench_weight.py

dkpy makes the largest excess small, the envelope that or the mean over log frequency; all lie above the profile.
"""

import time

import control as ct
import dkpy
import numpy as np
from measuring import hand_back, parser

import estimators as est
from estimators.uncertainty.nominal_model import log_measure

OMEGA = np.geomspace(1.0, 100.0, 100)


def plants(seed: int, count: int = 20) -> np.ndarray:
    """Responses of carts with a second mode, drawn around the paper's two natural frequencies."""
    random = np.random.default_rng(seed)
    found = []
    for a, b, c, d in random.uniform(-1, 1, (count, 4)):
        first, second = 12.9 * (1 + 0.05 * b), 37.4  # rad/s, paper, section 5.3
        system = ct.tf([1 + 0.2 * a], [1 / first**2, 0.4 * (1 + 0.3 * c) / first, 1])
        system += ct.tf([0.15 * (1 + 0.3 * d)], [1 / second**2, 0.2 / second, 1])
        found.append(system(1j * OMEGA))
    return np.array(found)


def main() -> None:
    """Print a table."""
    chosen = parser(__doc__).parse_args()
    measure, rows = log_measure(OMEGA), []
    print(
        "| plants | order of W | mean | dkpy | largest | largest, where that is minimised | dkpy | time [s] | dkpy [s] |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for seed in range(1 if chosen.small else 3):
        responses = plants(seed)
        for order in (1,) if chosen.small else (1, 2, 3):
            began = time.perf_counter()
            made = est.envelope(
                responses, omega=OMEGA, order_nominal=4, order_weight=order, within_db=60.0, progress=False
            )
            middle = time.perf_counter()
            at_most = est.envelope(
                responses, omega=OMEGA, nominal=made.nominal, order_weight=order, minimise="largest", within_db=60.0,
                progress=False,
            )  # fmt: skip
            ours, least = (20 * np.log10(e.weight_magnitude() / e.profile) for e in (made, at_most))
            dkpy_began = time.perf_counter()
            profile = made.profile[:, None, None].astype(complex)
            weight = dkpy.fit_uncertainty_weight(profile, OMEGA, order, weight=np.ones((len(OMEGA), 1)))
            theirs = 20 * np.log10(np.abs(np.squeeze(weight(1j * OMEGA))) / made.profile)
            ended = time.perf_counter()
            excess = (measure @ ours, measure @ theirs, ours.max(), least.max(), theirs.max())
            numbers = (*excess, middle - began, ended - dkpy_began)
            print(f"| {seed} | {order} | " + " | ".join(f"{n:.2f}" for n in numbers) + " |", flush=True)
            names = ("mean", "mean_dkpy", "largest", "largest_minimised", "largest_dkpy", "seconds", "seconds_dkpy")
            rows.append({"plants": seed, "order": order} | dict(zip(names, map(float, numbers), strict=True)))
    hand_back(chosen, {"rows": rows})


if __name__ == "__main__":
    main()
