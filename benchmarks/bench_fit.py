"""How fast a fit is, beside SciPy's least squares over Numba and optimistix over diffrax.

    python benchmarks/bench_fit.py [--experiments 18] [--samples 5000] [--limit 30]

First everybody solves the same problem, the starts given exactly: six parameters of a rig without dry friction, the same equations
and steps, from the same values. All must leave the same residual and end at the same parameters, or the program ends with an error.
Then as a user has it, who does not know the starts: held at what the first samples show, or estimated beside the parameters. Each
fit runs in a process of its own with nothing compiled, once with all compilation and then again; it is given up if that takes more
than twice `--limit` seconds.
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measuring import Found, best_of, hand_back, once, parser

# Relative difference of what is left, and difference of parameters relative to their values, over which it is not the same problem.
SAME_RESIDUAL, SAME_VALUES = 1e-8, 1e-5
NEEDS = {"package": (), "scipy_trf": ("numba",), "scipy_lm": ("numba",), "diffrax": ("diffrax", "optimistix")}
NAMES = {
    "package": "rtac-jax", "scipy_trf": "SciPy least_squares (trf) over Numba", "scipy_lm": "SciPy least_squares (lm) over Numba",
    "diffrax": "optimistix over diffrax",
}  # fmt: skip
STARTS = {"given": "starts given exactly", "held": "starts held at the first samples", "free": "starts estimated, too"}


class Ended(NamedTuple):
    """How a fit ended.

    Attributes:
        tool: that fitted.
        starts: what was known of them.
        first: wall time of the first run, with all compilation [s].
        seconds: of the best later one; None where the fit was given up.
        rms: of what is left, over the noise.
        values: of the parameters.
    """

    tool: str
    starts: str
    first: float | None = None
    seconds: float | None = None
    rms: float | None = None
    values: list[float] | None = None


def fit_here(tool: str, starts: str, experiments: int, samples: int) -> dict[str, Any]:
    """Fit in this process."""
    import rtac_jax as rtac

    rtac.configure(cache=None)
    from fit_tools import TOOLS
    from same_problem import problem

    data = problem(experiments, samples)
    # Building a simulator compiles, too.
    first, (fit, (values, rms)) = once(lambda: (made := TOOLS[tool](data, starts), made()))
    # A first run that took long is followed by one more only.
    seconds = best_of(2, fit) if first < 20 else once(fit)[0]
    return Ended(tool, starts, first, seconds, rms, [float(x) for x in values])._asdict()


def fit_in_a_child(tool: str, starts: str, chosen: argparse.Namespace) -> Ended:
    """Fit in a process of its own; without numbers where it takes too long."""
    with tempfile.NamedTemporaryFile(suffix=".json") as answer:
        command = [
            sys.executable, __file__, "--one", tool, starts, "--json", answer.name, "--experiments", str(chosen.experiments),
            "--samples", str(chosen.samples),
        ]  # fmt: skip
        try:
            subprocess.run(command, check=True, timeout=2 * chosen.limit + 20, stdout=subprocess.DEVNULL)
        except subprocess.TimeoutExpired:
            return Ended(tool, starts)
        return Ended(**json.loads(Path(answer.name).read_text()))


def require_same(ends: list[Ended]) -> None:
    """End the program where those that solve the same problem do not end at the same place."""
    first = ends[0]
    for other in ends[1:]:
        if first.rms is None or other.rms is None:
            continue
        apart = float(np.max(np.abs(np.array(other.values) / np.array(first.values) - 1)))
        if abs(other.rms / first.rms - 1) > SAME_RESIDUAL or apart > SAME_VALUES:
            raise SystemExit(
                f"{first.tool} leaves {first.rms:.10f} of the noise and {other.tool} {other.rms:.10f}, their parameters "
                f"{apart:.1e} apart: they did not solve the same problem"
            )


def ratios(ends: list[Ended]) -> dict[str, float]:
    """Times that the peers take over those of the package; of SciPy's methods the faster one."""
    took = {(e.tool, e.starts): e.seconds for e in ends if e.seconds is not None}
    found = {}
    peers = {"scipy_numba": ("scipy_trf", "scipy_lm"), "diffrax_optimistix": ("diffrax",)}
    for starts, name in (("given", "fit_vs_"), ("free", "fit_with_starts_vs_")):
        for peer, tools in peers.items():
            theirs = [took[tool, starts] for tool in tools if (tool, starts) in took]
            if theirs and ("package", starts) in took:
                found[name + peer] = round(min(theirs) / took["package", starts], 3)
    return found


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--experiments", type=int, default=18)
    made.add_argument("--samples", type=int, default=5000)
    made.add_argument("--limit", type=float, default=30.0, help="seconds after which a fit is given up")
    made.add_argument("--one", nargs=2, metavar=("TOOL", "STARTS"), help="fit once, in this process")
    chosen = made.parse_args()
    if chosen.small:
        chosen.experiments, chosen.samples = 3, 400
    if chosen.one:
        return hand_back(chosen, fit_here(*chosen.one, chosen.experiments, chosen.samples))
    here = {tool for tool, needs in NEEDS.items() if all(importlib.util.find_spec(n) for n in needs)}
    print(f"{chosen.experiments} experiments x {chosen.samples} samples on {os.cpu_count()} cores, six parameters")
    ends: list[Ended] = []
    for starts, said in STARTS.items():
        print(f"\n{said:58s} {'cold [s]':>10s} {'warm [s]':>10s} {'rms over noise':>16s}", flush=True)
        # MINPACK's lm cannot use the structure of 78 unknowns either; one method of SciPy is enough there.
        for tool in (t for t in NEEDS if t in here and not (starts != "given" and t == "scipy_lm")):
            if tool == "package" and starts == "held":
                continue  # nobody does that with the package
            end = fit_in_a_child(tool, starts, chosen)
            ends.append(end)
            name = NAMES[tool] + (", est.output_error" if (tool, starts) == ("package", "free") else "")
            if end.seconds is None:
                print(f"{name:58s} given up after {2 * chosen.limit + 20:.0f} s of two fits", flush=True)
            else:
                print(f"{name:58s} {end.first:10.2f} {end.seconds:10.3f} {end.rms:16.8f}", flush=True)
        if starts == "given":
            require_same(ends)
    if missing := set(NEEDS) - here:
        print("not here: " + ", ".join(sorted(missing)))
    found: Found = {"ratios": ratios(ends), "rows": [end._asdict() for end in ends]}
    hand_back(chosen, found)
    return None


if __name__ == "__main__":
    main()
