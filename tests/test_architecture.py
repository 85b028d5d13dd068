"""Layers: a module imports only from its own row or above; heavy libraries stay where they belong."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

import motorid

PACKAGE = Path(motorid.__file__).parent

ROWS = (
    # 0 words, numbers, single parameters
    "errors formatting progress display parameters term noise tables tasks",
    # 1 models and records
    "equations bases system model effects "
    "units headers dialect matfile table layout formats rows repairs experiment reading plausibility checks datasets",
    # 2 integration, and what is read from records before a problem is posed
    "integrate beginning steady prepared accuracy loss residuals unknowns relations constraints loads start coloured "
    "combinations outliers journal",
    # 3 the problem
    "problem derivatives sensitivity mesh misfit narrowing",
    # 4 solving it, and looking at the solution
    "least_squares descent plateaus balancing starting simulate result fit comparison multipliers conflict nlp nodes "
    "outcome gaps shooting remedies",
    # 5 how far it can be trusted, and what it lacks
    "identifiability uncertainty bootstrap profiling intervals endings multistart batch formulations diagnosis "
    "numbering",
    # 6 taking it along and showing it
    "export portable csource plots acquire summary explore report "
    "_html _html_tables _cards _cards_trust _sections _story",
    # 7 the command line and the public names
    "cli __main__ __init__",
)
# The two ways down: an object shows itself in a notebook by the module that draws such cards, and a fit asks the
# diagnosis for the order of an effect that repeats over a turn.
DRAWN_LATE = {("display", "_html"), ("_html", "_cards"), ("fit", "numbering")}
ONLY_IN = {"matplotlib": "plots", "serial": "acquire", "typer": "cli", "jinja2": "report"}
NOT_ON_IMPORT = ("matplotlib", "serial", "scipy.stats", "typer", "rich", "jinja2", "pandas", "distributed")


class Import(NamedTuple):
    """`unit` (first part of a name below motorid) imports `name` in `line`; `late`: inside a function."""

    unit: str
    name: str
    late: bool
    line: str


def unit_of(module: str) -> str:
    """First part of a module's name below motorid; all of ``cli_*`` is one unit."""
    name = (module.removeprefix("motorid").strip(".") or "__init__").split(".")[0]
    return "cli" if name.startswith("cli_") else name


def absolute(node: ast.ImportFrom, module: str, is_package: bool) -> str:
    """The module that ``from … import`` names, dots resolved."""
    if not node.level:
        return node.module or ""
    parts = module.split(".")
    base = parts[:len(parts) - node.level + is_package]
    return ".".join([*base, *([node.module] if node.module else [])])


def imports_of(path: Path) -> Iterator[Import]:
    """All imports of a file, but for those that only a type checker sees."""
    module = ".".join(["motorid", *path.relative_to(PACKAGE).with_suffix("").parts]).removesuffix(".__init__")

    def walk(node: ast.AST, late: bool) -> Iterator[Import]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                continue
            names = [a.name for a in child.names] if isinstance(child, ast.Import) else []
            if isinstance(child, ast.ImportFrom):
                found = absolute(child, module, path.name == "__init__.py")
                names = [f"motorid.{a.name}" for a in child.names] if found == "motorid" else [found]
            for name in names:
                yield Import(unit_of(module), name, late, f"{path.relative_to(PACKAGE)}:{child.lineno}")
            inside = late or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            yield from walk(child, inside)

    yield from walk(ast.parse(path.read_text(encoding="utf-8")), False)


@pytest.fixture(scope="module")
def imports() -> list[Import]:
    return [i for path in sorted(PACKAGE.rglob("*.py")) if "data" not in path.relative_to(PACKAGE).parts[:1]
            for i in imports_of(path)]


def row_of() -> dict[str, int]:
    return {unit: k for k, row in enumerate(ROWS) for unit in row.split()}


def test_every_module_has_a_row(imports):
    units = {unit_of(".".join(["motorid", *p.relative_to(PACKAGE).with_suffix("").parts]))
             for p in PACKAGE.glob("*.py")} | {p.parent.name for p in PACKAGE.glob("*/__init__.py")}
    assert units - set(row_of()) == set(), "put these into a row of ROWS"


def test_a_module_imports_from_its_own_row_or_above(imports):
    rows = row_of()
    inner = [i for i in imports if i.name.split(".")[0] == "motorid"]
    assert len(inner) > 200, "the reading of imports must not come up empty"
    down = [i for i in inner if rows[i.unit] < rows[unit_of(i.name)]]
    assert [i for i in down if not (i.late and (i.unit, unit_of(i.name)) in DRAWN_LATE)] == []


def test_the_way_down_is_still_needed(imports):
    used = {(i.unit, unit_of(i.name)) for i in imports if i.late and i.name.startswith("motorid.")}
    assert used >= DRAWN_LATE


def test_units_do_not_import_in_circles(imports):
    """At the level of modules, leaving out what is imported late."""
    edges: dict[str, set[str]] = {}
    for i in imports:
        if not i.late and i.name.startswith("motorid.") and unit_of(i.name) != i.unit:
            edges.setdefault(i.unit, set()).add(unit_of(i.name))
    done: set[str] = set()

    def visit(unit: str, way: tuple[str, ...]) -> None:
        assert unit not in way, f"circle: {' → '.join([*way, unit])}"
        if unit not in done:
            for other in sorted(edges.get(unit, ())):
                visit(other, (*way, unit))
            done.add(unit)

    for unit in sorted(edges):
        visit(unit, ())


@pytest.mark.parametrize("library", ONLY_IN)
def test_a_heavy_library_has_one_home(imports, library):
    homes = {i.unit for i in imports if i.name.split(".")[0] == library}
    assert homes <= {ONLY_IN[library]}


def test_rich_is_for_terminals_only(imports):
    homes = {i.unit for i in imports if i.name.split(".")[0] == "rich"}
    assert homes <= {"cli", "progress"}
    assert all(i.late for i in imports if i.name.split(".")[0] == "rich")


def test_importing_motorid_loads_nothing_heavy(tmp_path):
    code = f"import sys, motorid; print([m for m in {NOT_ON_IMPORT!r} if m in sys.modules])"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == "[]"


def test_modules_stay_small():
    sizes = {str(p.relative_to(PACKAGE)): len(p.read_text(encoding="utf-8").splitlines())
             for p in PACKAGE.rglob("*.py") if "data" not in p.relative_to(PACKAGE).parts[:1]}
    assert {name: n for name, n in sizes.items() if n > 300} == {}, "two things in one file: part them"


def test_the_data_makers_know_nothing_of_the_models():
    """The plant that makes the shipped records must not share code with what is tested on them."""
    data = next(d for d in (PACKAGE.parent / "data", PACKAGE / "data") if (d / "plant").is_dir())
    files = [*data.glob("*.py"), *data.glob("plant/*.py")]
    assert len(files) > 3
    for path in files:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            assert not [n for n in names if n.split(".")[0] == "motorid"], path.name
