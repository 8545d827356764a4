"""The documentation keeps up with the code: the reference names every public name, and every effect has a place on its page."""

import re
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
