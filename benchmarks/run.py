"""All benchmarks in one run: text, `results.json` and `results.png`.

    python benchmarks/run.py                                # everything, some 25 minutes on two cores; `make bench`
    python benchmarks/run.py --sections simulation fit      # these; the others' numbers stay as they are in results.json
    python benchmarks/run.py --small --out /tmp/bench       # with little, to show that it runs
    python benchmarks/run.py --picture                      # draw results.json again

Every section runs in a process of its own, with a folder for compiled code that is empty at first: what is called cold finds
nothing compiled. A section that fails is named at the end, the status is 1, and what the others found is kept. Ratios are of
times taken in one process, one after the other; the load of the machine and how many cores other programs took are written
beside each section.
"""

import argparse
import datetime
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import picture
import results_file
from measuring import Found, load

HERE = Path(__file__).parent
# What is run for each section, one process after the other with the same folder for compiled code.
SECTIONS: dict[str, list[list[str]]] = {
    "simulation": [["bench_simulation.py"]],
    "jacobian": [["bench_jacobian.py"]],
    "fit": [["bench_fit.py"]],
    "growth": [["bench_growth.py"]],
    "diagnosis": [["bench_diagnosis.py"], ["bench_diagnosis.py", "--again"]],
    "unknown": [["bench_diagnosis.py", "--unknown"]],
    "example": [["bench_commands.py", "example"]],
    "demo": [["bench_commands.py", "demo"]],
    "study": [["bench_study.py"]],
    "linear": [["bench_prediction_error.py"]],
    "subspace": [["bench_subspace.py"]],
    "weight": [["bench_weight.py"]],
}
_LONGEST = 1500.0  # [s] that one process may take, many times what it should


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=list(SECTIONS), metavar="NAME")
    parser.add_argument("--small", action="store_true", help="with little; needs --out, as its numbers mean nothing")
    parser.add_argument("--out", type=Path, default=HERE, metavar="FOLDER", help="of results.json and results.png")
    parser.add_argument("--picture", action="store_true", help="only draw what is in results.json")
    chosen = parser.parse_args()
    if chosen.small and chosen.out.resolve() == HERE:
        parser.error("--small needs an --out FOLDER of its own: its numbers mean nothing")
    chosen.out.mkdir(parents=True, exist_ok=True)
    file = chosen.out / "results.json"
    failed = [] if chosen.picture else run(chosen.sections, file, small=chosen.small)
    results = results_file.read(file)
    if results:
        picture.draw(results, chosen.out / "results.png")
        print(f"\n{summary(results)}\n{file}, {chosen.out / 'results.png'}")
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def run(sections: list[str], file: Path, *, small: bool) -> list[str]:
    """Run sections one after the other and keep what each finds; return the names of those that failed."""
    machine, commit, load_at_start = results_file.machine(), results_file.commit(), load()
    print(f"{machine['processor']}, {machine['cores']} cores; commit {commit}; load {load_at_start}")
    failed = []
    for name in sections:
        print(f"\n== {name} " + "=" * (100 - len(name)), flush=True)
        before, others, began = load(), Others(), time.perf_counter()
        found = section(SECTIONS[name], small=small)
        if found is None:
            failed.append(name)
            continue
        about: dict[str, Any] = {
            "load": {"start": before, "end": load(), "others": others.cores()},
            "took": round(time.perf_counter() - began, 1),
            "finished": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "commit": commit, "machine": machine, "small": small,
        }  # fmt: skip
        print(f"-- {name}: {about['took']:.0f} s; other programs used {about['load']['others']:.2f} cores", flush=True)
        results = results_file.read(file)  # another run may have written since
        results_file.write(file, results_file.merged(results, name, found, about, load_at_start=load_at_start))
    return failed


def section(commands: list[list[str]], *, small: bool) -> Found | None:
    """Run the processes of one section; return what they found, None if one failed."""
    found: Found = {}
    with tempfile.TemporaryDirectory(prefix="rtac-bench-") as folder:
        cache, answer = Path(folder) / "cache", Path(folder) / "found.json"
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache), "MPLBACKEND": "agg"}
        for script, *options in commands:
            command = [sys.executable, str(HERE / script), *options, "--json", str(answer), *["--small"] * small]
            try:
                status = subprocess.run(command, env=environment, timeout=_LONGEST, check=False).returncode
            except subprocess.TimeoutExpired:
                status = f"more than {_LONGEST:.0f} s"
            if status != 0 or not answer.exists():
                print(f"{script}: ended with {status}", file=sys.stderr, flush=True)
                return None
            for kind, value in json.loads(answer.read_text()).items():
                if kind in found and kind != "megabytes":  # what several processes found of one kind stands together
                    found[kind] = found[kind] + value if isinstance(value, list) else found[kind] | value
                else:
                    found[kind] = value
            answer.unlink()
    return found


class Others:
    """How many cores programs other than this one and its children use, from now on."""

    def __init__(self) -> None:
        self.began, self.busy, self.own = time.perf_counter(), _busy(), _own()

    def cores(self) -> float:
        """Return the mean since then; children count once they have ended."""
        wall = time.perf_counter() - self.began
        found = max(_busy() - self.busy - (_own() - self.own), 0.0) / wall
        return round(min(found, os.cpu_count() or 1), 2)  # ticks of the clock count more over a short time


def _busy() -> float:
    """Processor time of all programs [s]."""
    user, nice, system, _, _, irq, softirq, steal = map(int, Path("/proc/stat").read_text().split()[1:9])
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")


def _own() -> float:
    of = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in of)


def summary(results: dict[str, Any]) -> str:
    """Ratios, seconds and memory as text."""
    lines = [f"{'':34s} {'ratio':>10s}"]
    lines += [f"{name:34s} {value:10.2f}" for name, value in results.get("ratios", {}).items()]
    lines += ["", f"{'':34s} {'seconds':>10s}"]
    lines += [f"{name:34s} {value:10.1f}" for name, value in results.get("seconds", {}).items()]
    if "megabytes" in results:
        lines += ["", f"{'megabytes of a diagnosis':34s} {results['megabytes']:10.0f}"]
    if not results["quiet"]:
        lines += ["", "Other programs used the machine meanwhile: seconds are too long, and ratios less certain."]
    if lacking := results_file.missing(results):
        lines += ["", "not measured: " + ", ".join(lacking)]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
