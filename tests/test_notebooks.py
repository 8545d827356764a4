"""Every notebook runs from top to bottom, in a copy, and ends in an assertion about what it showed."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
SILVERBOX = "08_silverbox"
# What these show, the tests of `make test` show on smaller recordings; they take half a minute to three minutes each.
LONG = {
    "02_closed_form", "03_output_error", "04_find_the_missing_effect", "05_prediction_error", "06_envelope", "07_control",
    "09_monte_carlo",
    "10_your_own_rig", SILVERBOX,
}  # fmt: skip
# What the machinery around a kernel warns of says nothing about a notebook, and what a notebook's own kernel warns of
# it shows in its output.
pytestmark = pytest.mark.filterwarnings("ignore")


def _silverbox_is_here() -> bool:
    return any((folder / "shared/data/silverbox/SNLS80mV.mat").is_file() for folder in ROOT.parents)


def _cases() -> list:
    absent = pytest.mark.skipif(not _silverbox_is_here(), reason="the Silverbox data are not in shared/data/silverbox")
    return [
        pytest.param(
            path,
            id=path.stem,
            marks=[absent] * (path.stem == SILVERBOX) + [pytest.mark.slow] * (path.stem in LONG),
        )
        for path in NOTEBOOKS
    ]


def _code(notebook) -> list:
    return [cell for cell in notebook.cells if cell.cell_type == "code" and cell.source.strip()]


def _asserts(source: str) -> bool:
    return any(isinstance(node, ast.Assert) for node in ast.walk(ast.parse(source)))


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", [pytest.param(path, id=path.stem) for path in NOTEBOOKS])
def test_notebook_is_kept_with_output_and_ends_in_an_assertion(path):
    import nbformat

    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = _code(notebook)
    assert notebook.cells[0].cell_type == "markdown", "the first cell states the question"
    assert "?" in notebook.cells[0].source.splitlines()[0], "the first cell states the question"
    assert "rtac.configure()" in code[0].source
    assert _asserts(code[-1].source), "the last code cell asserts what was shown"
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), "run once from top to bottom"
    outputs = [output for cell in code for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    assert any("image/png" in output.get("data", {}) for output in outputs), "kept with its figures"


def _imported(source: str) -> list[str]:
    """Every dotted name that a cell imports; what a cell asks of IPython is no Python."""
    code = "\n".join(line for line in source.splitlines() if not line.startswith("%"))
    nodes = list(ast.walk(ast.parse(code)))
    plain = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    parts = [
        f"{node.module}.{alias.name}" for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names
    ]
    return plain + parts


@pytest.mark.parametrize("path", [pytest.param(path, id=path.stem) for path in NOTEBOOKS])
def test_notebook_imports_nothing_private(path):
    """What a reader copies into a script of his own must be there in the next version."""
    import nbformat

    imported = [name for cell in _code(nbformat.read(path, as_version=4)) for name in _imported(cell.source)]
    assert any(name.split(".")[0] == "rtac_jax" for name in imported)
    assert not [name for name in imported if any(part.startswith("_") for part in name.split("."))]


@pytest.mark.parametrize("path", _cases())
def test_notebook_runs(path, tmp_path, monkeypatch):
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    copy = nbformat.read(path, as_version=4)
    # The folder stays that of the notebook, from where it looks for data; nothing is written there.
    client = NotebookClient(
        copy, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}
    )
    client.execute()  # raises where a cell fails
    nbformat.write(copy, tmp_path / path.name)
    outputs = [output for cell in _code(copy) for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    assert any("image/png" in output.get("data", {}) for output in outputs)
