"""Pages of the site that are made, not written: the catalogue of effects, and the files of the repository's root."""

import inspect
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

from rtac_jax.effects import CATALOGUE, Effect
from rtac_jax.parameters import declarations

ROOT = Path(__file__).parents[1]
FROM_THE_ROOT = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
PORTS = {
    "cart": "On the cart",
    "arm": "On the arm",
    "input": "On how the inputs run between samples",
    "actuator": "Between the recorded current and the motor",
    "force": "Between the recorded force and the cart",
    "sensor": "Between the motion and what is recorded",
}
INTRODUCTION = """# Effects

The catalogue: every effect that a diagnosis looks for, built from the classes in `rtac_jax.effects`. An effect is absent where its
parameters have their null value; a parameter without one only shapes it. `model + rtac.effects.CubicSpring(5e4)` is a model with
one effect more. [One of your own](guide/own_effect.md) takes part beside these.
"""


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are made."""
    for source, page in FROM_THE_ROOT.items():
        files.append(File.generated(config, page, content=as_page(source)))
    files.append(File.generated(config, "effects.md", content=catalogue()))
    return files


def as_page(source: str) -> str:
    """Return a file of the root with its links turned into those of the site; links out of docs/ become plain text."""
    text = ROOT.joinpath(source).read_text()
    return re.sub(r"\]\(docs/", "](", text)


def catalogue() -> str:
    """Return the page of all effects, by where they act."""
    parts = [INTRODUCTION]
    unplaced = [effect.id for effect in CATALOGUE.values() if port_of(effect) not in PORTS]
    if unplaced:
        raise ValueError(f"PORTS of docs/hooks.py names no port of {', '.join(unplaced)}; add it.")
    for port, title in PORTS.items():
        parts.append(f"## {title}\n")
        parts.extend(section(effect) for effect in CATALOGUE.values() if port_of(effect) == port)
    return "\n".join(parts)


def port_of(effect: type[Effect]) -> str:
    """Return the first port that an effect names."""
    return re.split(r"\W+", effect.port)[0]


def section(effect: type[Effect]) -> str:
    """Return what the catalogue says of one effect."""
    lines = [
        f"### {effect.id} {{ #{effect.id} }}\n",
        f"`rtac.effects.{effect.__name__}` · {inspect.getdoc(effect)}\n",
        f"- Equation: `{effect.equation}`",
        f"- Source: {effect.source}",
    ]
    nature = getattr(effect, "nature", None)
    if nature:
        lines.append(f"- Nature: {nature}")
    if effect.states:
        lines.append("- States: " + ", ".join(f"{name} [{unit}]" for name, unit in effect.states.items()))
    lines += ["", "| parameter | symbol | unit | bounds | absent at | meaning |", "|---|---|---|---|---|---|"]
    for name, declared in declarations(effect).items():
        low, high = (f"{bound:g}" for bound in declared.bounds)
        null = "" if declared.null is None else f"{declared.null:g}"
        cells = (f"`{name}`", f"`{declared.symbol}`", declared.unit, f"{low} to {high}", null, declared.meaning)
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"
