"""How long fit and diagnosis with the whole catalogue take, with what is compiled for them and without, and their memory.

    python benchmarks/bench_diagnosis.py [--experiments 18] [--samples 5000] [--hidden cubic_spring nothing]
    python benchmarks/bench_diagnosis.py --again      # only the first recording, with code that an earlier process left on disk
    python benchmarks/bench_diagnosis.py --unknown    # five runs of 4 s that hide what is not in the catalogue

The rig is the independent virtual one at 500 Hz; a third of the experiments are free decays. Of two recordings of each kind the
first is cold: all compilation counts, unless JAX_COMPILATION_CACHE_DIR names a folder that holds some. The second, of another rig,
is warm: it finds the code of the first. The memory is the largest of the process after the first diagnosis.
"""

import argparse
import dataclasses
import os

import diagnosis_cases
from measuring import Found, hand_back, once, parser, peak_megabytes

import estimators as est
import rtac_jax as rtac
from rtac_jax import virtual_rig

HIDDEN = {"nothing": {}, "cubic_spring": {"cubic_spring": 5e4}}
OUTSIDE = "outside: friction along the way"


def recorded(chosen: argparse.Namespace, hidden: dict, draw: int) -> rtac.Recording:
    """Record a rig of that draw that hides something."""
    rig = dataclasses.replace(virtual_rig.Rig().drawn(draw), **hidden)
    free = chosen.experiments // 3
    plans = virtual_rig.standard_plans(
        seed=draw, sample_time=chosen.sample_time, duration=chosen.sample_time * chosen.samples, free=free,
        forced=chosen.experiments - free, rest=1,
    )  # fmt: skip
    return virtual_rig.record(rig, plans, seed=draw)


def main() -> None:
    """Command line."""
    made = parser(__doc__)
    made.add_argument("--experiments", type=int, default=18)
    made.add_argument("--samples", type=int, default=5000)
    made.add_argument("--sample-time", type=float, default=0.002)
    made.add_argument("--hidden", nargs="+", choices=HIDDEN, default=["cubic_spring"])
    made.add_argument("--again", action="store_true", help="only the first recording; its times are called cached")
    made.add_argument("--unknown", action="store_true", help="five runs of 4 s with an effect outside the catalogue")
    chosen = made.parse_args()
    cases = {name: HIDDEN[name] for name in chosen.hidden}
    if chosen.unknown:
        chosen.experiments, chosen.samples, chosen.sample_time = 5, 800, 0.005
        cases = {"unknown": dict(diagnosis_cases.OUTSIDE[OUTSIDE].hidden)}
    if chosen.small:
        chosen.experiments, chosen.samples = 3, 400
    # Without a folder nothing compiled before is found.
    rtac.configure(cache=os.environ.get("JAX_COMPILATION_CACHE_DIR"))
    print(f"{chosen.experiments} experiments x {chosen.samples} samples, {len(rtac.effects.CATALOGUE)} effects")
    print(f"{'hidden':14s} {'':>6s} {'fit [s]':>8s} {'diagnosis [s]':>14s} {'memory [MiB]':>13s}  verdict")
    found: Found = {"seconds": {}, "rows": []}
    for hidden, values in cases.items():
        for draw, call in enumerate(("cached",) if chosen.again else ("cold", "warm"), start=5):
            recording = recorded(chosen, values, draw)
            model = rtac.RTAC.from_rig(recording)
            fitted, fit = once(lambda m=model, r=recording: est.output_error(m, r, progress=False))
            took, verdict = once(lambda f=fit, r=recording: est.diagnose(f, r, progress=False))
            memory, named = peak_megabytes(), ", ".join(c.id for c in verdict.effects)
            print(
                f"{hidden:14s} {call:>6s} {fitted:8.1f} {took:14.1f} {memory:13.0f}  {verdict.verdict} {named}",
                flush=True,
            )
            row = {
                "hidden": hidden, "call": call, "fit": fitted, "diagnosis": took, "megabytes": memory,
                "verdict": f"{verdict.verdict} {named}".strip(), "steps": fit.statistics["steps"],
            }  # fmt: skip
            found["rows"].append(row)
            if hidden == "unknown":
                found["seconds"][f"unknown_{call}"] = round(took, 2)
            elif hidden == "cubic_spring":
                found["seconds"] |= {f"fit_{call}": round(fitted, 2), f"diagnose_{call}": round(took, 2)}
                if call == "cold":
                    found["megabytes"] = round(memory)
    hand_back(chosen, found)


if __name__ == "__main__":
    main()
