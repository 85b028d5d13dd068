"""Notebooks: they run, they were saved as they run, they tell the story with public names only."""

import ast
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

import motorid as mi

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
REAL = "07_real_records"  # needs records that are not shipped
pytestmark = pytest.mark.skipif(not NOTEBOOKS, reason="an installed package has no notebooks")


@pytest.fixture(params=NOTEBOOKS, ids=lambda p: p.stem)
def path(request):
    return request.param


@pytest.fixture
def notebook(path):
    return nbformat.read(path, as_version=4)


def code_of(notebook):
    return [c for c in notebook.cells if c.cell_type == "code"]


def test_every_notebook_is_valid_small_and_of_readable_length(path, notebook):
    nbformat.validate(notebook)
    assert path.stat().st_size < 1_200_000
    assert 10 <= len(notebook.cells) <= 26


def test_every_notebook_begins_with_its_title_and_explains_as_it_goes(notebook):
    assert notebook.cells[0].cell_type == "markdown"
    assert notebook.cells[0].source.startswith("# ")
    in_a_row = re.findall(r"c+", "".join(c.cell_type[0] for c in notebook.cells))
    assert max(map(len, in_a_row)) <= 3


def test_it_is_saved_with_its_outputs_and_without_a_hitch(notebook):
    numbers = [c.execution_count for c in code_of(notebook)]
    assert numbers == list(range(1, len(numbers) + 1))
    for cell in code_of(notebook):
        for out in cell.outputs:
            assert out.output_type != "error"
            assert out.get("name") != "stderr", out.text
        if re.search(r"^mi\.plot_", cell.source, re.M):
            assert any("image/png" in o.get("data", {}) for o in cell.outputs), cell.source


def test_it_tells_nothing_of_the_machine_it_was_made_on(notebook):
    assert not re.search(r"/(work|tmp|root|home|Users)/", nbformat.writes(notebook))


def test_it_imports_public_names_only_and_owns_no_helper(path, notebook):
    for cell in code_of(notebook):
        for node in ast.walk(ast.parse(cell.source)):
            if isinstance(node, ast.ImportFrom):
                assert not (node.module or "").startswith("motorid"), cell.source
            if isinstance(node, ast.Attribute):
                assert not node.attr.startswith("_"), cell.source
                if isinstance(node.value, ast.Name) and node.value.id == "mi":
                    assert hasattr(mi, node.attr), node.attr
            if isinstance(node, ast.FunctionDef):
                decorators = [ast.unparse(d) for d in node.decorator_list]
                assert any(d.startswith("mi.effect(") for d in decorators), f"{path.name} defines {node.name}"


def test_links_between_notebooks_lead_somewhere(notebook):
    text = "\n".join(c.source for c in notebook.cells if c.cell_type == "markdown")
    for target in re.findall(r"\]\((\d\d_\w+\.ipynb)\)", text):
        assert (FOLDER / target).is_file(), target


@pytest.mark.slow
def test_it_runs_from_top_to_bottom(path, notebook, request, monkeypatch):
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel chooses its own
    if path.stem == REAL:
        request.getfixturevalue("real")
    for cell in code_of(notebook):
        cell.outputs, cell.execution_count = [], None
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}
    ).execute()
    for cell in code_of(notebook):
        for out in cell.outputs:
            assert out.get("name") != "stderr", out.text
        if re.search(r"^mi\.plot_", cell.source, re.M):
            assert any("image/png" in o.get("data", {}) for o in cell.outputs), cell.source
