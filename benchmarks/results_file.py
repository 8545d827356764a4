"""`results.json`: what sections found, put together one after the other, each with the machine and the load under which it ran."""

import json
import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from measuring import Found

from rtac_jax.measurement.atomic_write import replacing

RATIOS = ("batch_512_vs_c", "single_vs_c", "jacobian_vs_simulation", "fit_vs_scipy_numba", "fit_vs_diffrax_optimistix")
SECONDS = (
    "fit_cold", "fit_warm", "diagnose_cold", "diagnose_warm", "unknown_warm", "demo_cold", "example_cold",
)  # fmt: skip
"""What a whole run holds, beside `megabytes`."""

_PACKAGES = ("rtac-jax", "jax", "jaxlib", "numpy", "scipy", "numba", "diffrax", "optimistix")
_QUIET = 0.25  # cores that other programs may use on a machine that is called quiet


def machine() -> dict[str, Any]:
    """Processor, cores, memory and versions."""
    versions = {}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = None
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gigabytes": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "system": platform.platform(),
        "python": platform.python_version(),
        "compiler": _first_line(["gcc", "--version"]),
        "versions": versions,
    }


def commit() -> str:
    """The commit that is measured, with a mark where the packages were changed since."""
    at = Path(__file__).parent
    found = _first_line(["git", "-C", str(at), "rev-parse", "--short", "HEAD"])
    changed = _first_line(["git", "-C", str(at), "status", "--porcelain", "--", ":/rtac_jax", ":/estimators"])
    return found + "+" * bool(changed) if found else ""


def _processor() -> str:
    found: dict[str, str] = {}
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        name, _, value = line.partition(":")
        found.setdefault(name.strip(), value.strip())
    # A virtual machine may hide the model's name.
    vectors = (
        "AVX-512" if "avx512f" in found.get("flags", "") else "AVX2" if "avx2" in found.get("flags", "") else "SSE"
    )
    numbers = ", ".join(f"{n} {found[n]}" for n in ("cpu family", "model") if n in found)
    return f"{found.get('model name', platform.machine())} ({numbers}), {vectors}"


def _first_line(command: list[str]) -> str:
    try:
        said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return ""
    return said.splitlines()[0] if said else ""


def read(path: Path) -> dict[str, Any]:
    """What is there already."""
    return json.loads(path.read_text()) if path.exists() else {}


def merged(
    results: dict[str, Any], name: str, found: Found, run: dict[str, Any], *, load_at_start: float
) -> dict[str, Any]:
    """Return the results with those of one section in the place of its earlier ones.

    Args:
        results: so far.
        name: of the section.
        found: by it.
        run: of it: load, seconds, commit, machine.
        load_at_start: of the machine when the whole run began.
    """
    results = {**results, "sections": {**results.get("sections", {}), name: {**run, **found}}}
    for kind in ("ratios", "seconds"):
        # Of the sections alone: what one no longer finds, as a peer that was given up, is not kept from an earlier run.
        several = [one.get(kind) or {} for one in results["sections"].values()]
        results[kind] = dict(sorted({key: value for each in several for key, value in each.items()}.items()))
    if "megabytes" in found:
        results["megabytes"] = found["megabytes"]
    runs = results["sections"].values()
    # Sections may come from several runs; a number is worth what its own section's load leaves it.
    results["load"] = {"start": load_at_start, "end": run["load"]["end"]}
    results["quiet"] = all(one["load"]["others"] < _QUIET for one in runs)
    results["machine"], results["commit"] = run["machine"], run["commit"]
    return results


def write(path: Path, results: dict[str, Any]) -> None:
    """Write beside the file and put it in its place: whoever reads it sees a whole one."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(results, indent=1, sort_keys=False) + "\n")


def missing(results: dict[str, Any]) -> list[str]:
    """Names of what a whole run has and these results have not."""
    names = [f"ratios.{n}" for n in RATIOS if n not in results.get("ratios", {})]
    names += [f"seconds.{n}" for n in SECONDS if n not in results.get("seconds", {})]
    return names + ["megabytes"] * ("megabytes" not in results)
