"""`results.png`: what `results.json` holds, as one picture."""

import functools
import textwrap
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from rtac_jax.measurement.atomic_write import replacing

OWN, PEER, FLOOR = "#0b6e99", "#b8b8b8", "#d1603d"
COLD, CACHED, WARM = "#08415c", "#0b6e99", "#8ecae6"
TOOLS = {
    "package": "rtac-jax",
    "scipy_trf": "SciPy (trf), Numba",
    "scipy_lm": "SciPy (lm), Numba",
    "diffrax": "optimistix, diffrax",
}


def draw(results: dict[str, Any], path: Path) -> None:
    """Draw what is there; a part that was not run is said to be missing."""
    figure, axes = plt.subplots(2, 3, figsize=(19, 11), layout="constrained")
    one, several = (functools.partial(simulation, single=single) for single in (True, False))
    parts = [one, several, fits, waiting, growth, memory]
    sections = results.get("sections", {})
    for ax, part in zip(axes.ravel(), parts, strict=True):
        part(ax, results, sections)
    about = results["machine"]
    quiet = "nothing else running" if results["quiet"] else "other programs running, so seconds are too long"
    figure.suptitle(
        f"{headline(results)}\n{about['processor']}, {about['cores']} cores, commit {results['commit']}, {quiet}",
        fontsize=13,
    )
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=100, format="png")
    plt.close(figure)


def headline(results: dict[str, Any]) -> str:
    """Say in one line how fast the package is."""
    ratios = results.get("ratios", {})
    said = []
    if "batch_512_vs_c" in ratios:
        batch, single = ratios["batch_512_vs_c"], ratios["single_vs_c"]
        said.append(f"a batch is simulated in {batch:.1f} times the time of C, one trajectory in {single:.0f} times")
    faster = {"SciPy over Numba": "fit_vs_scipy_numba", "optimistix over diffrax": "fit_vs_diffrax_optimistix"}
    peers = [f"{1 / ratios[key]:.2g} times the time of {name}" for name, key in faster.items() if key in ratios]
    if peers:
        said.append("a fit in " + " and in ".join(peers))
    return "; ".join(said)[:1].upper() + "; ".join(said)[1:]


def _empty(ax: Axes, title: str) -> None:
    ax.set_title(title, fontsize=11)
    ax.text(0.5, 0.5, "not run", ha="center", va="center", transform=ax.transAxes)
    ax.set_axis_off()


def _bars(ax: Axes, names: list[str], values: list[float], colours: list[str], form: str) -> None:
    """Horizontal bars from the fastest to the slowest, on a logarithmic axis, with their values."""
    bars = ax.barh(range(len(names)), values, color=colours)
    ax.bar_label(bars, [form.format(v) for v in values], padding=3, fontsize=9)
    ax.set_yticks(range(len(names)), [textwrap.fill(name, 22) for name in names], fontsize=9)
    ax.invert_yaxis()
    ax.set_xscale("log")
    ax.set_xlim(0.5 * min(values), 12 * max(values))


def simulation(ax: Axes, results: dict[str, Any], sections: dict[str, Any], *, single: bool) -> None:
    title, key = ("One trajectory", "single_vs_c") if single else ("512 trajectories at once", "batch_512_vs_c")
    if "simulation" not in sections:
        return _empty(ax, title)
    rows = [r for r in sections["simulation"]["rows"] if (r["trajectories"] == 1) == single]
    rows.sort(key=lambda r: r["nanoseconds"])
    colours = [OWN if r["name"].startswith("rtac") else FLOOR if r["name"].startswith("C ") else PEER for r in rows]
    _bars(ax, [r["name"] for r in rows], [r["nanoseconds"] for r in rows], colours, "{:,.0f}")
    ax.set_xlabel("ns per step and trajectory")
    ratio = results["ratios"].get(key)
    ax.set_title(title + (f": {ratio:.3g} times the time of C" if ratio else ""), fontsize=11)
    return None


def fits(ax: Axes, results: dict[str, Any], sections: dict[str, Any]) -> None:
    if "fit" not in sections:
        return _empty(ax, "Fit beside peers")
    names, values, colours = [], [], []
    given_up = []
    for row in sections["fit"]["rows"]:
        if row["starts"] == "held":
            continue
        name = f"{TOOLS[row['tool']]}, starts {'given' if row['starts'] == 'given' else 'estimated'}"
        if row["seconds"] is None:
            given_up.append(name)
            continue
        names.append(name)
        values.append(row["seconds"])
        colours.append(OWN if row["tool"] == "package" else PEER)
    _bars(ax, names, values, colours, "{:.2f}")
    ax.set_xlabel("warm, seconds")
    ax.set_title("Six parameters fitted to the same data", fontsize=11)
    if given_up:
        ax.set_xlabel("warm, seconds; given up:\n" + "\n".join(given_up))
    return None


def waiting(ax: Axes, results: dict[str, Any], sections: dict[str, Any]) -> None:
    seconds = results.get("seconds", {})
    works = {
        "fit": "fit", "diagnose": "diag-\nnosis", "unknown": "un-\nknown", "example": "README's\nexample", "demo": "rtac\ndemo",
    }  # fmt: skip
    calls = {
        "cold": ("nothing compiled", COLD),
        "cached": ("compiled code on disk", CACHED),
        "warm": ("in the same process", WARM),
    }
    works = {key: name for key, name in works.items() if any(f"{key}_{call}" in seconds for call in calls)}
    if not works:
        return _empty(ax, "Waiting")
    for place, (call, (label, colour)) in enumerate(calls.items()):
        at = [n for n, key in enumerate(works) if f"{key}_{call}" in seconds]
        values = [seconds[f"{list(works)[n]}_{call}"] for n in at]
        bars = ax.bar([n + 0.27 * (place - 1) for n in at], values, width=0.25, color=colour, label=label)
        ax.bar_label(bars, [f"{v:.0f}" if v >= 10 else f"{v:.1f}" for v in values], fontsize=9)
    ax.set_xticks(range(len(works)), list(works.values()), fontsize=9)
    ax.set_ylabel("seconds")
    ax.set_ylim(0, 1.3 * ax.get_ylim()[1])
    ax.legend(fontsize=9, loc="upper right")
    ax.set_title("How long a user waits (fit and diagnosis: 18 x 5,000)", fontsize=11)
    return None


def growth(ax: Axes, results: dict[str, Any], sections: dict[str, Any]) -> None:
    if "growth" not in sections:
        return _empty(ax, "Growth")
    rows = sections["growth"]["rows"]
    for changed in dict.fromkeys(r["changed"] for r in rows):
        of = [r for r in rows if r["changed"] == changed]
        # Zero effects have no place on a logarithmic axis: the size of what grows is that of the data or of the unknowns.
        if of[0]["size"] > 0 and changed in ("samples", "experiments"):
            sizes = [r["size"] / of[0]["size"] for r in of]
            ax.loglog(sizes, [1e3 * r["step"] for r in of], "o-", label=f"{changed}, from {of[0]['size']:,}")
    lowest, highest = ax.get_xlim()
    first = rows[0]
    ax.loglog([1, highest], [1e3 * first["step"], 1e3 * first["step"] * highest], "k:", lw=1, label="in proportion")
    ax.set_xlim(lowest, highest)
    ax.set_xlabel("times the smallest size (6 experiments x 1,000 samples)")
    ax.set_ylabel("residual with Jacobian [ms]")
    ax.legend(fontsize=9)
    others = [
        f"{r['size']} {r['changed']}: {1e3 * r['step']:.0f} ms"
        for r in rows
        if r["changed"] in ("parameters", "effects")
    ]
    ax.text(0.98, 0.03, "\n".join(others), ha="right", va="bottom", fontsize=8, transform=ax.transAxes)
    ax.set_title("A step of a fit grows with the data", fontsize=11)
    return None


def memory(ax: Axes, results: dict[str, Any], sections: dict[str, Any]) -> None:
    names, values = [], []
    for section, label in (("diagnosis", "diagnosis, 18 x 5,000"), ("unknown", "unknown, 5 x 800")):
        for row in sections.get(section, {}).get("rows", [])[:1]:
            names.append(label)
            values.append(row["megabytes"])
    for row in sections.get("growth", {}).get("rows", []):
        if row["changed"] in ("samples", "experiments"):
            names.append(f"fit, {row['size']:,} {row['changed']}")
            values.append(row["megabytes"])
    for row in sections.get("study", {}).get("rows", [])[:1]:
        names += ["study, a worker, after its first chunk", "and at the end"]
        values += row["megabytes"]
    if not names:
        return _empty(ax, "Memory")
    bars = ax.barh(range(len(names)), values, color=OWN, height=0.7)
    ax.bar_label(bars, [f"{v:,.0f}" for v in values], padding=3, fontsize=9)
    ax.set_yticks(range(len(names)), [textwrap.fill(name, 22) for name in names], fontsize=9)
    ax.invert_yaxis()
    ax.set_xlim(0, 1.3 * max(values))
    ax.set_xlabel("largest resident memory [MiB],\nof which 300 are Python and its libraries")
    largest = f": a diagnosis takes {values[0] / 1024:.1f} GiB" if names[0].startswith("diagnosis") else ""
    ax.set_title(f"Memory of a process{largest}", fontsize=11)
    return None
