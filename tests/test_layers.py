"""What import-linter cannot say of the house: no package looks into the private modules of another."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def imported(path: Path) -> Iterator[str]:
    """Yield the dotted names that a file imports, wherever in the file it does so."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("package", ["rtac_jax", "estimators"])
def test_private_modules_are_imported_within_their_package_only(package: str) -> None:
    other = {"rtac_jax": "estimators", "estimators": "rtac_jax"}[package]
    private = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / package).rglob("_*.py")
        if path.name != "__init__.py"
    }
    files = [*(ROOT / other).rglob("*.py"), *(ROOT / "benchmarks").glob("*.py")]
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in files
        for name in imported(path)
        if any(name == module or name.startswith(f"{module}.") for module in private)
    ]
    assert not wrong
    assert len(files) > 50


def test_only_the_command_line_imports_the_root_of_estimators() -> None:
    # What is above a module would be imported within functions only, and no contract on rooms would see it.
    package = ROOT / "estimators"
    rooms = {f"estimators.{path.stem}" for path in package.iterdir()}
    files = [path for path in package.rglob("*.py") if path.parent not in (package, package / "cli")]
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in files
        for name in imported(path)
        if name == "estimators" or (name.count(".") == 1 and name.startswith("estimators.") and name not in rooms)
    ]
    assert not wrong
    assert len(files) > 100


def test_no_module_imports_a_private_name_of_another() -> None:
    # Tests may: what they look at within a module is no part of what it offers.
    files = [*(path for package in ("rtac_jax", "estimators", "benchmarks") for path in (ROOT / package).rglob("*.py"))]
    wrong = [
        f"{path.relative_to(ROOT)}: {alias.name} of {node.module}"
        for path in files
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and node.module  # without one they are modules of the same package
        for alias in node.names
        if alias.name.startswith("_") and not alias.name.startswith("__")
    ]
    assert not wrong
    assert len(files) > 300
