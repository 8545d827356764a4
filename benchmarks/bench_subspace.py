"""Poles by prediction error beside those by a subspace method (nfoursid's N4SID), on the same data.

    python benchmarks/bench_subspace.py [--runs 40]

One resonance at -0.8 + 10.46j rad/s, 2,000 samples of 20 ms, white input; noise of each model set in turn. The subspace
method starts many toolboxes' fits, and makes no error smallest.
"""

import time

import nfoursid.nfoursid
import numpy as np
import pandas
import scipy.signal
from measuring import hand_back, parser

import estimators as est
import rtac_jax as rtac
from rtac_jax.measurement import Experiment, Recording

STEP, SAMPLES = 0.02, 2000
A, B, C, _, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss([2.0, 30.0], [1.0, 1.6, 110.0]), STEP)
POLE = -0.8 + 1j * np.sqrt(110.0 - 0.8**2)
SHARED = np.poly(np.linalg.eigvals(A)).real
NOISES = {
    "output_error": (([1.0], [1.0]), 0.1),
    "box_jenkins": (([1.0, 0.5, 0.3], [1.0, -1.4, 0.6]), 0.03),
    "armax": (([1.0, 0.4, 0.1], SHARED), 0.01),
    "state_space": (([1.0, -0.6, 0.2], SHARED), 0.02),
}


def signals(structure: str, runs: int) -> tuple[np.ndarray, np.ndarray]:
    """Input and noisy output of all runs."""
    random = np.random.default_rng(8)
    (numerator, denominator), std = NOISES[structure]
    current, state = random.standard_normal((runs, SAMPLES)), np.zeros((runs, 2))
    out = np.empty_like(current)
    for n in range(SAMPLES):
        out[:, n] = state @ C[0]
        state = state @ A.T + current[:, n : n + 1] * B[:, 0]
    white = std * random.standard_normal((runs, SAMPLES + 500))
    return current, out + scipy.signal.lfilter(numerator, denominator, white, axis=1)[:, 500:]


def subspace(current: np.ndarray, out: np.ndarray) -> complex:
    """The upper pole by N4SID."""
    frame = pandas.DataFrame({"u": current, "y": out})
    fit = nfoursid.nfoursid.NFourSID(frame, ["y"], ["u"], num_block_rows=15)
    fit.subspace_identification()
    poles = np.log(np.linalg.eigvals(fit.system_identification(rank=2)[0].a).astype(complex)) / STEP
    return complex(poles[np.argmax(poles.imag)])


def main() -> None:
    """Print a table."""
    made = parser(__doc__)
    made.add_argument("--runs", type=int, default=40)
    chosen = made.parse_args()
    runs, rows = 2 if chosen.small else chosen.runs, []
    rtac.configure()
    print("| noise of | error of the pole [rad/s], rms | N4SID | time [s] | N4SID |")
    print("|---|---|---|---|---|")
    for structure in NOISES:
        current, out = signals(structure, runs)
        data = Recording(
            tuple(
                Experiment.of(f"run_{i}", kind="forced", sample_time=STEP, current=u, cart_position=y)
                for i, (u, y) in enumerate(zip(current, out, strict=True))
            )
        )
        est.prediction_error(data, structure=structure, compensate=False, progress=False)  # compiles
        began = time.perf_counter()
        found = est.prediction_error(data, structure=structure, compensate=False, progress=False)
        middle = time.perf_counter()
        theirs = np.array([subspace(u, y) for u, y in zip(current, out, strict=True)])
        ended = time.perf_counter()
        ours = np.array([one.poles[np.argmax(one.poles.imag)] for one in found])
        sizes = [float(np.sqrt(np.mean(np.abs(poles - POLE) ** 2))) for poles in (ours, theirs)]
        print(
            f"| {structure} | {sizes[0]:.4f} | {sizes[1]:.4f} | {middle - began:.2f} | {ended - middle:.2f} |",
            flush=True,
        )
        errors = dict(zip(("error", "error_n4sid"), sizes, strict=True))
        rows.append({"noise": structure, **errors, "seconds": middle - began, "seconds_n4sid": ended - middle})
    hand_back(chosen, {"rows": rows})


if __name__ == "__main__":
    main()
