"""What ruff cannot say of docstrings: they document arguments that there are."""

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
Function = ast.FunctionDef | ast.AsyncFunctionDef


def public_functions(path: Path) -> Iterator[Function]:
    """Yield the public functions and methods of a file, those of private classes left out."""
    nodes: list[ast.AST] = [ast.parse(path.read_text())]
    while nodes:
        for node in ast.iter_child_nodes(nodes.pop()):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                nodes.append(node)
            elif isinstance(node, Function) and not node.name.startswith("_"):
                yield node


def documented(docstring: str) -> list[str]:
    """Return the names under `Args:`; lines that go on with one before are indented further than the first."""
    lines = inspect.cleandoc(docstring).splitlines()
    if "Args:" not in lines:
        return []
    names: list[str] = []
    indent = None
    for line in lines[lines.index("Args:") + 1 :]:
        if not line.strip():
            continue
        deep = len(line) - len(line.lstrip())
        if deep == 0:
            break
        indent = indent or deep
        if deep == indent:
            entry = re.match(r"([^:(]+?)\s*(?:\([^)]*\))?:", line.strip())
            names += re.split(r",\s*|\s+and\s+", entry[1]) if entry else [line.strip()]
    return [name.lstrip("*`").rstrip("`") for name in names]


def parameters(function: Function) -> set[str]:
    """Return the names that a signature has."""
    a = function.args
    several = (*a.posonlyargs, *a.args, *a.kwonlyargs, a.vararg, a.kwarg)
    return {one.arg for one in several if one is not None}


@pytest.mark.parametrize("package", ["rtac_jax", "estimators"])
def test_documented_arguments_are_arguments(package: str) -> None:
    found = [
        (f"{path.relative_to(ROOT)}:{function.lineno} {function.name}: {name}", name in parameters(function))
        for path in (ROOT / package).rglob("*.py")
        for function in public_functions(path)
        for name in documented(ast.get_docstring(function) or "")
    ]
    assert not [place for place, there in found if not there]
    assert len(found) > 50


def test_names_are_found_where_lines_are_wrapped() -> None:
    docstring = """Do it.

    Args:
        first: of two, and what it
            means: nothing.
        second, third: the rest.
        **options: of another.

    Returns:
        other: no argument.
    """
    assert documented(docstring) == ["first", "second", "third", "options"]
