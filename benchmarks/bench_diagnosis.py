"""How long a diagnosis with the whole catalogue takes, with what is compiled for it and without.

    python benchmarks/bench_diagnosis.py [--experiments 18] [--samples 5000]

The rig is the independent virtual one at 500 Hz; a third of the experiments are free decays. Seconds of the first call count
all compilation; of two recordings with nothing, and with a cubic spring hidden, the second of each kind finds its code compiled.
"""

import argparse
import dataclasses
import time

import estimators as est
import rtac_jax as rtac
from rtac_jax import virtual_rig

HIDDEN = {"nothing": {}, "cubic_spring": {"cubic_spring": 5e4}}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiments", type=int, default=18)
    parser.add_argument("--samples", type=int, default=5000)
    arguments = parser.parse_args()
    rtac.configure(cache=None)  # or what an earlier run compiled would not be counted
    free = arguments.experiments // 3
    print(f"{arguments.experiments} experiments x {arguments.samples} samples, {len(rtac.effects.CATALOGUE)} effects")
    print(f"{'hidden':14s} {'call':>6s} {'fit [s]':>8s} {'diagnosis [s]':>14s}  verdict")
    for hidden, values in HIDDEN.items():
        for call in ("first", "second"):
            rig = dataclasses.replace(virtual_rig.Rig().drawn(len(call)), **values)
            plans = virtual_rig.standard_plans(
                seed=len(call), sample_time=0.002, duration=0.002 * arguments.samples, free=free,
                forced=arguments.experiments - free, rest=1,
            )  # fmt: skip
            recording = virtual_rig.record(rig, plans, seed=len(hidden))
            began = time.perf_counter()
            fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
            fitted = time.perf_counter() - began
            found = est.diagnose(fit, recording, progress=False)
            named = ", ".join(c.id for c in found.effects)
            print(f"{hidden:14s} {call:>6s} {fitted:8.1f} {found.seconds:14.1f}  {found.verdict} {named}", flush=True)


if __name__ == "__main__":
    main()
