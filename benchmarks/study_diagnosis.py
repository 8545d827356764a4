"""False alarms, power and confusion of the diagnosis on virtual rigs that its development never saw.

    python benchmarks/study_diagnosis.py run results.jsonl --draws 5                    # goes on where it was killed
    python benchmarks/study_diagnosis.py run results.jsonl --draws 34 --only nothing    # more of one kind
    python benchmarks/study_diagnosis.py table results.jsonl

Rigs are drawn within 15 % around the paper's, sampled at 500 Hz with 12 bits; every rig of an odd draw is shaken by random
forces and torques. Draw 0 has been looked at in development, so draws begin at 1. Every line of the result file is one
recording: what was hidden, what was named, and what the tests said.
"""

import argparse
import collections
import dataclasses
import json
import time
from pathlib import Path

import estimators as est
import rtac_jax as rtac
from rtac_jax import virtual_rig

_SEED = 900_000  # far from the seeds of the tests
_SHAKEN = {"force_noise": 1e-3, "torque_noise": 3e-5}

# Moderate sizes: the base model's error is a few times the noise.
EFFECTS: dict[str, dict[str, float]] = {
    "cubic_spring": {"cubic_spring": 5e4},
    "quadratic_spring": {"quadratic_spring": 600.0},
    "flexible_mode": {"flexible_mass": 0.08, "flexible_frequency": 37.4, "flexible_damping": 0.03},
    "cart_quadratic_drag": {"cart_quadratic_drag": 2.0},
    "cart_stribeck": {"cart_stribeck": 0.02, "cart_stribeck_velocity": 0.01},
    "hysteretic_spring": {"hysteresis_stiffness": 20.0, "hysteresis_yield": 1e-3},
    "end_stop": {"end_stop_travel": 0.009},
    "arm_coulomb": {"arm_coulomb": 4e-4},
    "arm_stribeck": {"arm_stribeck": 4e-4, "arm_stribeck_velocity": 1.0},
    "arm_quadratic_drag": {"arm_quadratic_drag": 3e-6},
    "cogging": {"cogging_torque": 4e-4, "cogging_order": 7.0, "cogging_phase": 0.7},
    "cable_spring": {"cable_stiffness": 5e-5},
    "gravity_tilt": {"tilt_across": 0.01},
    "saturation": {"saturation": 0.25},
    "current_lag": {"current_lag": 0.01},
    "input_delay": {"input_delay": 0.004},
    "dead_zone": {"dead_zone": 0.01},
    "current_offset": {"current_offset": 0.005},
    "torque_droop": {"torque_droop": 0.3},
    "tacho_bias": {"tacho_bias": 0.2},
    "tacho_gain": {"tacho_gain": 1.03},
    "tacho_lag": {"tacho_lag": 0.005},
    "lvdt_nonlinearity": {"lvdt_cubic": 300.0},
    "lvdt_lag": {"lvdt_lag": 0.005},
}
OUTSIDE: dict[str, dict[str, float]] = {
    "outside: friction along the way": {"friction_slope": 2.0},
    "outside: magnetic detent": {"detent_force": 0.05},
    "outside: floor vibration": {"vibration_force": 0.05},
    "outside: Maxwell spring": {"maxwell_stiffness": 10.0},
    "outside: eddy brake": {"eddy_torque": 1e-3, "eddy_velocity": 10.0},
}
NULLS: dict[str, tuple[dict[str, float], int]] = {
    "nothing, white noise": ({}, 1),
    "nothing, coloured noise": ({"noise_correlation": 0.9}, 1),
    "nothing, doubled noise": ({"noise_factor": 2.0}, 1),
    "nothing, white noise, no rest": ({}, 0),
    "nothing, coloured noise, no rest": ({"noise_correlation": 0.9}, 0),
}


def cases(draws: int) -> list[tuple[str, int, dict[str, float], int]]:
    """Name, draw, what the rig hides, and rest records."""
    every = [(n, v, 1) for n, v in (EFFECTS | OUTSIDE).items()] + [(n, v, r) for n, (v, r) in NULLS.items()]
    return [(name, draw, values, rest) for draw in range(1, draws + 1) for name, values, rest in every]


def one(name: str, draw: int, hidden: dict[str, float], rest: int) -> dict[str, object]:
    """Record and diagnose one rig."""
    seed = _SEED + 1000 * draw + sum(map(ord, name))
    rig = dataclasses.replace(virtual_rig.Rig().drawn(seed), **(_SHAKEN if draw % 2 else {}), **hidden)
    plans = virtual_rig.standard_plans(
        seed=seed + 1, sample_time=0.002, duration=5.0, free=2, forced=4, rest=rest, repeats=1
    )
    recording = virtual_rig.record(rig, plans, seed=seed + 2)
    began = time.perf_counter()
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    found = est.diagnose(fit, recording, progress=False)
    return {
        "case": name,
        "draw": draw,
        "shaken": bool(draw % 2),
        "verdict": found.verdict,
        "effects": [c.id for c in found.effects],
        "groups": {c.id: c.confusable_with for c in found.effects},
        "removed": found.removed,
        "rejects": [t.test for t in found.tests if t.rejects],
        "seconds": time.perf_counter() - began,
    }


def run(path: Path, draws: int, only: str) -> None:
    """Add what is missing in the result file."""
    done = {(r["case"], r["draw"]) for r in read(path)} if path.exists() else set()
    todo = [c for c in cases(draws) if (c[0], c[1]) not in done and only in c[0]]
    rtac.configure()
    for number, case in enumerate(todo, 1):
        result = one(*case)
        with path.open("a") as file:
            file.write(json.dumps(result) + "\n")
        print(f"{number}/{len(todo)} {case[0]} {case[1]}: {result['verdict']} {result['effects']}", flush=True)


def read(path: Path) -> list[dict]:
    """All complete lines; one that a kill cut short is left out."""
    found = []
    for line in path.read_text().splitlines():
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return found


def outcome(result: dict) -> str:
    """What the verdict was worth."""
    truth, verdict, named = result["case"], result["verdict"], result["effects"]
    if truth in EFFECTS:
        if verdict == "missing":
            return "right" if named == [truth] else "right and more" if truth in named else "wrong"
        if verdict == "ambiguous":
            return "in the group" if truth in named else "wrong"
        return verdict
    if verdict in ("missing", "ambiguous"):
        return "wrong"
    return verdict


def table(path: Path) -> str:
    """Markdown: one row for each case."""
    counts: dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
    wrong: dict[str, set[str]] = collections.defaultdict(set)
    for result in read(path):
        counts[result["case"]][outcome(result)] += 1
        if outcome(result) in ("wrong", "right and more"):
            wrong[result["case"]].add(" + ".join(result["effects"]))
    columns = ("right", "right and more", "in the group", "unknown", "adequate", "wrong")
    lines = [f"| hidden | {' | '.join(columns)} | named instead |", "|---" * (len(columns) + 2) + "|"]
    for name, values in counts.items():
        cells = " | ".join(str(values[c]) if values[c] else "" for c in columns)
        lines.append(f"| {name} | {cells} | {'; '.join(sorted(wrong[name]))} |")
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=["run", "table"])
    parser.add_argument("file", type=Path)
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    arguments = parser.parse_args()
    if arguments.action == "run":
        run(arguments.file, arguments.draws, arguments.only)
    else:
        print(table(arguments.file))


if __name__ == "__main__":
    main()
