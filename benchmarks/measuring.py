"""What every section of the benchmarks shares: best times, memory, and how a section hands back what it found.

A section is a script that prints a text and, with `--json FILE`, writes there what goes into `results.json`: an object with any of
`ratios`, `seconds`, `megabytes` and `rows`. With `--small` it does the same with little, to show that it runs.
"""

import argparse
import json
import os
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

Found = dict[str, Any]
"""What a section found, as it goes into `results.json`."""


def best_of(repeats: int, work: Callable[[], object], *, longest: float = 60.0) -> float:
    """Shortest wall time [s] of several runs after one that compiles; no more runs once they took the longest."""
    work()
    found: list[float] = []
    while len(found) < repeats and sum(found) < longest:
        found.append(once(work)[0])
    return min(found)


def once(work: Callable[[], Any]) -> tuple[float, Any]:
    """Wall time [s] of one run, and what it returned."""
    began = time.perf_counter()
    result = work()
    return time.perf_counter() - began, result


def peak_megabytes() -> float:
    """Largest resident memory of this process so far [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def parser(doc: str | None) -> argparse.ArgumentParser:
    """A command line with what every section takes."""
    made = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--small", action="store_true", help="with little, to show that it runs")
    made.add_argument("--json", type=Path, metavar="FILE", help="write what was found there")
    return made


def hand_back(arguments: argparse.Namespace, found: Found) -> None:
    """Write what was found where the command line says."""
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(found))


def load() -> float:
    """Programs that wanted a core, in the mean over the last minute."""
    return round(os.getloadavg()[0], 2)
