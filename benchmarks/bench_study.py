"""How fast a Monte Carlo study of output error is, beside SciPy fits over a Numba simulator in a pool of processes.

    python benchmarks/bench_study.py [--repetitions 1000] [--peer 60] [--workers 2]

A repetition simulates six free decays with other parameters and other noise, 5,000 samples in all, and fits three parameters
and the four states at the start of each decay, 27 unknowns. Everyone runs on the same cores, begins at the same values (the true
parameters, and what the first samples show of the starts), and is timed after its code is compiled. The peer integrates the same
equations by the same steps, dry friction included, and `scipy.optimize.least_squares` differentiates it by differences: once as it
stands, once with a Jacobian that knows that a start acts on its own decay only. Both reach the same residual, or the program
ends with an error. Without Numba the peer is left out.
"""

import importlib.util
import multiprocessing
import os
import resource
import time
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import Any

import numpy as np
from measuring import Found, hand_back, parser, peak_megabytes

STEP, SAMPLES, DECAYS = 0.005, 833, 6
FREE = ("spring_stiffness", "cart_viscous.coefficient", "cart_coulomb.level")
K, V, D = 132.6, 0.5543, 0.024
M, ME, J, KV1, KV2 = 1.23, 1.06e-3, 9.5e-5, 1.39e-4, 1.49e-4
POSITION, VELOCITY = 2e-5, 0.05  # noise [m, rad/s]
ANGLE_SPREAD = 0.1  # rad, of an arm set by hand, as the package takes it
SAME = 1e-3  # relative difference of the residuals of both, on the same data


def numba_simulator() -> Any:
    """Return a function that writes cart position and arm velocity of one decay; the package's steps, written again."""
    import numba

    @numba.njit(fastmath=True, cache=True)
    def accelerations(q, w, p, r, way, k, v, d):
        sine, cosine = np.sin(p), np.cos(p)
        cart = -k * q - v * w - way * d + ME * r * r * sine
        arm = -(KV1 if r > 0 else KV2) * r
        exchange = ME * cosine
        scale = 1 / (M * J - exchange * exchange)
        return scale * (J * cart - exchange * arm), scale * (M * arm - exchange * cart)

    @numba.njit(fastmath=True, cache=True)
    def simulate(k, v, d, start, shown):
        q, w, p, r = start
        h = STEP
        for n in range(shown.shape[1]):
            shown[0, n], shown[1, n] = q, r
            way = np.sign(w)
            w1, r1 = accelerations(q, w, p, r, way, k, v, d)
            w2, r2 = accelerations(q + h / 2 * w, w + h / 2 * w1, p + h / 2 * r, r + h / 2 * r1, way, k, v, d)
            qb, pb = w + h / 2 * w1, r + h / 2 * r1
            w3, r3 = accelerations(q + h / 2 * qb, w + h / 2 * w2, p + h / 2 * pb, r + h / 2 * r2, way, k, v, d)
            qc, pc = w + h / 2 * w2, r + h / 2 * r2
            w4, r4 = accelerations(q + h * qc, w + h * w3, p + h * pc, r + h * r3, way, k, v, d)
            qd, pd = w + h * w3, r + h * r3
            aq, aw = q + h / 6 * (w + 2 * (qb + qc) + qd), w + h / 6 * (w1 + 2 * (w2 + w3) + w4)
            ap, ar = p + h / 6 * (r + 2 * (pb + pc) + pd), r + h / 6 * (r1 + 2 * (r2 + r3) + r4)
            # Where the cart comes to rest within the step, the step is cut there.
            exchange = ME * np.cos(p)
            most = h * d * J / (M * J - exchange * exchange)
            forward = 1.0 if w > 0 or (w == 0 and aw > 0) else -1.0
            begin, end = forward * w, forward * aw
            resting = w == 0
            driven = end - begin + (0.0 if resting else most)
            if not end >= (most if resting else 0.0):
                apart = most - driven
                rest = begin / apart if apart > 0 else 0.0
                back = min(driven + most, 0.0) * (1 - rest)
                change, shift = back - end, 0.5 * (rest * begin + (1 - rest) * back) - 0.5 * (begin + end)
            else:
                change = -most if resting else 0.0
                shift = 0.5 * change
            held = resting and not end >= (most if resting else 0.0)
            by = -exchange / J
            aq, aw = aq + h * forward * shift, aw + forward * change
            ap, ar = ap + h * by * forward * shift, ar + by * forward * change
            if held:
                aq, aw = q, 0.0
            q, w, p, r = aq, aw, ap, ar

    return simulate


class Peer:
    """SciPy's fit over the Numba simulator."""

    def __init__(self) -> None:
        self.simulate = numba_simulator()
        self.scale = np.array([K, V, D] + [0.02, 0.3, 1.0, 3.0] * DECAYS) * 0.1

    def outputs(self, unknowns: np.ndarray) -> np.ndarray:
        """Return cart position and arm velocity of all decays [decay channel sample]."""
        shown = np.empty((DECAYS, 2, SAMPLES))
        for decay in range(DECAYS):
            self.simulate(*unknowns[:3], unknowns[3 + 4 * decay : 7 + 4 * decay], shown[decay])
        return shown

    def fit(self, measured: np.ndarray, angles: np.ndarray, first: np.ndarray, *, blocks: bool) -> Any:
        """Fit all unknowns.

        Args:
            measured: of all decays [decay channel sample].
            angles: of the arm at the start, as set by hand.
            first: unknowns to begin at.
            blocks: whether the Jacobian knows that a start acts on its own decay only.
        """
        from scipy.optimize import least_squares

        noise = np.array([POSITION, VELOCITY])[:, None]

        def errors(z: np.ndarray) -> np.ndarray:
            at = z * self.scale
            known = (at[5::4] - angles) / ANGLE_SPREAD
            return np.concatenate([((self.outputs(at) - measured) / noise).ravel(), known])

        def jacobian(z: np.ndarray) -> np.ndarray:
            base, step = errors(z), 1.5e-8
            found = np.zeros((len(base), len(z)))
            for column in range(3):
                moved = z.copy()
                moved[column] += step * max(1.0, abs(z[column]))
                found[:, column] = (errors(moved) - base) / (moved[column] - z[column])
            length = 2 * SAMPLES
            for state in range(4):
                moved = z.copy()
                moved[3 + state :: 4] += step * np.maximum(1.0, np.abs(z[3 + state :: 4]))
                change = errors(moved) - base
                for decay in range(DECAYS):
                    column = 3 + 4 * decay + state
                    rows = [*range(decay * length, (decay + 1) * length), DECAYS * length + decay]
                    found[rows, column] = change[rows] / (moved[column] - z[column])
            return found

        ended = least_squares(
            errors, first / self.scale, jacobian if blocks else "2-point", method="trf", x_scale="jac"
        )
        return ended.x * self.scale, ended.fun[: DECAYS * 2 * SAMPLES].reshape(DECAYS, 2, SAMPLES)


_PEER: list[Peer] = []


def peer_repetition(index: int, blocks: bool) -> float:
    """Simulate and fit one repetition, in a worker of the pool; return the rms of what is left over the noise."""
    if not _PEER:
        _PEER.append(Peer())
    peer, random = _PEER[0], np.random.default_rng(index)
    true = np.concatenate([np.array([K, V, D]) * random.uniform(0.9, 1.1, 3), np.zeros(4 * DECAYS)])
    true[3::4], true[5::4] = random.uniform(0.005, 0.02, DECAYS), random.uniform(-3, 3, DECAYS)
    shown = peer.outputs(true)
    measured = shown + np.array([POSITION, VELOCITY])[:, None] * random.standard_normal(shown.shape)
    _, left = peer.fit(measured, true[5::4], _first(true[:3], measured, true[5::4]), blocks=blocks)
    return float(np.sqrt(np.mean(left**2)))


def _first(parameters: np.ndarray, measured: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return the unknowns to begin at: these parameters, and starts as the first samples show them."""
    first = np.concatenate([parameters, np.zeros(4 * DECAYS)])
    time_of = STEP * np.arange(9)
    for decay in range(DECAYS):
        curve = np.polynomial.Polynomial.fit(time_of, measured[decay, 0, :9], 2)
        speed = np.polynomial.Polynomial.fit(time_of, measured[decay, 1, :9], 2)
        first[3 + 4 * decay : 7 + 4 * decay] = curve(0.0), curve.deriv()(0.0), angles[decay], speed(0.0)
    return first


def used(_: int) -> tuple[int, float, float]:
    """Return this process's number, largest memory [MiB] and processor time [s]."""
    time.sleep(0.2)  # so that every worker answers
    now = resource.getrusage(resource.RUSAGE_SELF)
    return os.getpid(), peak_megabytes(), now.ru_utime + now.ru_stime


def used_by(pool: Executor, workers: int) -> tuple[float, float]:
    """Return the largest memory of a worker [MiB], and the processor time of all [s]."""
    found = {number: (memory, seconds) for number, memory, seconds in pool.map(used, range(4 * workers))}
    return max(memory for memory, _ in found.values()), sum(seconds for _, seconds in found.values())


def study_of(repetitions: int, seed: int) -> Any:
    """Return the study that is timed."""
    import estimators as est
    from estimators.study import Estimate, Excitation, Fitted, Noise, Plant

    return est.StudySpec(
        name="speed", repetitions=repetitions, seed=seed,
        plant=Plant(truth="model", values={n: [0.9 * x, 1.1 * x] for n, x in zip(FREE, (K, V, D), strict=True)}),
        noise=Noise(position=POSITION, velocity=VELOCITY),
        excitation=(Excitation(duration=SAMPLES * STEP, sample_time=STEP, free=DECAYS, forced=0, rest=1),),
        model=Fitted(free=FREE, start="truth"), estimate=(Estimate("output_error"),),
    )  # fmt: skip


def require_same_residual(results: Any) -> float:
    """Return the largest relative difference of what both leave of the same data; more than `SAME` ends the program."""
    import estimators as est
    from estimators.study.recordings import recordings
    from estimators.study.truth import true_for
    from rtac_jax import RTAC

    peer, worst = Peer(), 0.0
    spec = results.spec
    for index in range(3):
        truth = true_for(spec, index)
        (recording,) = recordings(spec, [index], [truth])
        assert not isinstance(recording, str)
        moving = [e for e in recording if e.kind == "free"]
        measured = np.array([[e.outputs[c].values for c in ("cart_position", "arm_velocity")] for e in moving])
        angles = np.array([e.initial_arm_angle for e in moving])
        model = RTAC.from_rig(recording)
        model = model.fix(*(set(model.free) - set(FREE)))
        own = est.output_error_batch(model, [recording], progress=False)
        values = np.array([truth.values[name] for name in FREE])
        _, left = peer.fit(measured, angles, _first(values, measured, angles), blocks=True)
        for row, (channel, noise) in enumerate((("cart_position", POSITION), ("arm_velocity", VELOCITY))):
            theirs = noise * np.sqrt(np.mean(left[:, row] ** 2))
            worst = max(worst, abs(float(own.residual_std[channel][0]) / theirs - 1))
    if worst > SAME:
        raise SystemExit(f"the residuals differ by {worst:.1e}: both do not fit the same")
    return worst


def main() -> None:
    """Time both and print the ratio."""
    import estimators as est
    import rtac_jax as rtac

    made = parser(__doc__)
    made.add_argument("--repetitions", type=int, default=1000)
    made.add_argument("--peer", type=int, default=60, help="repetitions of the peer, whose time is scaled up")
    made.add_argument("--workers", type=int, default=2)
    chosen = made.parse_args()
    if chosen.small:
        chosen.repetitions, chosen.peer = 8, 2
    workers, count = chosen.workers, chosen.repetitions
    print(rtac.configure())
    spawned = multiprocessing.get_context("spawn")
    chunk = min(250, -(-count // (2 * workers)))
    with ProcessPoolExecutor(workers, mp_context=spawned) as pool:
        # Compiles, and takes the memory that a chunk takes.
        est.study(study_of(chunk * workers, seed=2), executor=pool, chunk=chunk, progress=False)
        (before, started), began = used_by(pool, workers), time.perf_counter()
        results = est.study(study_of(count, seed=1), executor=pool, chunk=chunk, progress=False)
        own = (time.perf_counter() - began) / count
        after, ended = used_by(pool, workers)
    own_processor = (ended - started) / count
    residual = float(results["quantities"].sel(estimator="output_error", quantity="residual").values.mean())
    each, processor = f"{1e3 * own:.1f} ms each", f"{1e3 * own_processor:.1f} ms"
    print(f"est.study: {count} repetitions in {own * count:.1f} s, {each}, of a processor {processor}")
    print(f"{results.ending} Largest residual over noise {residual:.3f} in the mean")
    print(f"memory of a worker: {before:.0f} MiB after its first chunk, {after:.0f} MiB at the end")
    found: Found = {
        "ratios": {},
        "seconds": {"study_1000": round(1000 * own, 2)},
        "rows": [{"tool": "est.study", "wall": own, "processor": own_processor, "megabytes": [before, after]}],
    }
    if importlib.util.find_spec("numba") is None:
        print("SciPy over Numba is left out: Numba is not installed here (pip install numba).")
        return hand_back(chosen, found)
    print(f"on the same data both leave the same residual, to {require_same_residual(results):.0e}")
    # A process for each core: more threads of linear algebra would wait for each other, and take ten times as long.
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    with ProcessPoolExecutor(workers, mp_context=spawned) as pool:
        for blocks, name in ((False, "as it stands"), (True, "with a Jacobian by blocks")):
            list(pool.map(peer_repetition, range(1000, 1000 + 2 * workers), [blocks] * 2 * workers))
            (_, started), began = used_by(pool, workers), time.perf_counter()
            left = list(pool.map(peer_repetition, range(chosen.peer), [blocks] * chosen.peer))
            each = (time.perf_counter() - began) / chosen.peer
            processor = (used_by(pool, workers)[1] - started) / chosen.peer
            print(
                f"SciPy over Numba, {name}: {1e3 * each:.0f} ms each, {each / own:.1f} times as long; of a processor "
                f"{1e3 * processor:.0f} ms, {processor / own_processor:.1f} times ({np.mean(left):.3f} of the noise left)"
            )
            found["rows"].append({"tool": f"SciPy over Numba, {name}", "wall": each, "processor": processor})
            found["ratios"]["study_vs_scipy_numba" + "_blocks" * blocks] = round(each / own, 3)
    return hand_back(chosen, found)


if __name__ == "__main__":
    main()
