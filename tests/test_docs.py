"""The documentation keeps up with the code: the reference names every public name, and every effect has a place on its page."""

import ast
import re
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

import estimators
import rtac_jax

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("package", [rtac_jax, estimators], ids=lambda package: package.__name__)
def test_the_reference_names_every_public_name(package: ModuleType) -> None:
    page = ROOT.joinpath("docs", "api", f"{package.__name__}.md").read_text()
    named = set(re.findall(rf"^::: {package.__name__}\.(\w+)$", page, re.MULTILINE))
    assert named == {
        name for name in package.__all__ if name != "__version__" and not isinstance(getattr(package, name), ModuleType)
    }


def test_every_effect_acts_where_its_page_has_a_place() -> None:
    hooks = ROOT.joinpath("docs", "hooks.py").read_text()
    places = set(re.findall(r'^    "(\w+)": "', hooks, re.MULTILINE))
    assert len(places) > 3
    assert {re.split(r"\W+", effect.port)[0] for effect in rtac_jax.effects.CATALOGUE.values()} == places


@pytest.mark.parametrize("page", [ROOT / "README.md", ROOT / "CONTRIBUTING.md"], ids=lambda page: page.name)
def test_links_of_the_root_lead_somewhere(page: Path) -> None:
    """Those within docs/ are checked when the site is built."""
    links = re.findall(r"\]\(([^)#:]+)", page.read_text())
    assert links
    assert not [link for link in links if not ROOT.joinpath(link).exists()]


@pytest.mark.parametrize("page", sorted((ROOT / "docs").rglob("*.md")), ids=lambda page: page.stem)
def test_links_of_the_site_stay_in_it(page: Path) -> None:
    """`make docs` refuses others, and is no part of `make test`."""
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).resolve().is_relative_to(ROOT / "docs"), f"{page.name}: {target}"


def test_contributing_lists_the_rooms_in_the_order_of_imports() -> None:
    contracts = tomllib.loads(ROOT.joinpath("pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    listed = re.findall(r"^\| `(\w+)` \|", ROOT.joinpath("CONTRIBUTING.md").read_text(), re.MULTILINE)
    assert listed == contracts[0]["layers"]


GUIDE = ROOT / "docs" / "guide"


def examples(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)


@pytest.mark.parametrize("page", sorted(GUIDE.glob("*.md")), ids=lambda page: page.stem)
def test_examples_of_the_guide_are_python_and_call_what_there_is(page: Path) -> None:
    for block in examples(page):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                package = {"est": estimators, "rtac": rtac_jax, "virtual_rig": rtac_jax.virtual_rig}.get(node.value.id)
                assert package is None or hasattr(package, node.attr), f"{node.value.id}.{node.attr}"


def test_cheap_examples_of_the_guide_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("your_rig", "your_csv", "own_effect"):  # in order: the second reads what the first has written
        for block in examples(GUIDE / f"{name}.md"):
            exec(block, {})
    assert rtac_jax.Recording.load("rig.h5").rig["total_mass"] == 1.23
