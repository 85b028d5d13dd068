"""The house: layers, no circles, one home for heavy libraries, names, sizes; each rule fails on a broken house."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import pytest

import motorid

# Rooms from the ground up: a file imports from its own room and from rows above its own, not from a neighbour.
# ".": the package's own face. `python -m motorid` is the door of the command line.
LAYERS = (
    "errors channels",
    "display numerics",
    "records model",
    "effects integrate acquire",
    "problem",
    "estimation",
    "uncertainty",
    "diagnosis",
    "plots exporters",
    "reports",
    "cli .",
)
DOORS = {"__main__": "cli"}
ROOT_FILES = {"__init__.py", "__main__.py", "errors.py", "channels.py", "py.typed"}
# What a room may know beside itself (modules by the start of their names), where that is less than all above it.
KNOWS = {
    "errors": (),
    "channels": (),
    "display": (),
    "numerics": ("errors",),
    "model": ("errors", "channels", "display", "numerics"),
    "effects": ("errors", "model"),
    "integrate": ("errors", "numerics", "model.equations"),
    "acquire": ("errors", "channels", "display", "records.datasets"),
}
HOMES = {"matplotlib": "plots", "serial": "acquire", "typer": "cli", "jinja2": "reports.report",
         "rich": "cli numerics.parallel", "threadpoolctl": "numerics.parallel"}
LATE = ("matplotlib", "serial", "typer", "jinja2", "rich", "pandas", "distributed", "threadpoolctl",
        "scipy.stats", "scipy.special", "scipy.optimize", "scipy.linalg", "scipy.fft", "scipy.sparse", "scipy.ndimage")
FACES = {".", "effects", "integrate", "acquire", "plots", "cli"}  # their __init__ hands names on
MOODS = {"held", "revival", "revived", "hardly", "endings", "ending", "beginning", "narrowing", "remedies", "surely",
         "judgement", "astray", "adrift", "favourite"}
LONGEST_FUNCTION = 45  # lines of code without the docstring
MOST_FILES, MOST_LINES, MOST_LAYERS = 130, 27_570, 11


class Import(NamedTuple):
    """`source` imports `target`, a module of the package or another one's full name; `late`: not when it is loaded."""

    source: str
    target: str
    names: tuple[str, ...]
    late: bool
    line: str


class House:
    """A package as its files and imports tell it; modules by their names below it, its own face is ``.``."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.name = folder, folder.name
        self.files = {self._module(p): p for p in sorted(folder.rglob("*.py")) if self._is_code(p)}
        self.trees = {m: ast.parse(p.read_text(encoding="utf-8")) for m, p in self.files.items()}

    def _is_code(self, path: Path) -> bool:
        return "data" not in path.relative_to(self.folder).parts[:1]  # the wheel carries the records there

    def _module(self, path: Path) -> str:
        parts = path.relative_to(self.folder).with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts) or "."

    def room(self, module: str) -> str:
        """First part of a module's name."""
        first = module.split(".")[0] or "."
        return DOORS.get(first, first)

    def line(self, module: str, node: ast.AST) -> str:
        """Where a node stands."""
        return f"{self.files[module].relative_to(self.folder)}:{getattr(node, 'lineno', 1)}"

    @cached_property
    def imports(self) -> list[Import]:
        """All of them: late ones, and those that only a type checker sees."""
        return [i for module in self.files for i in self._imports_of(module)]

    @cached_property
    def inner(self) -> list[Import]:
        """Those from the package itself."""
        return [i for i in self.imports if i.target in self.files]

    def _imports_of(self, module: str) -> Iterator[Import]:
        def walk(node: ast.AST, late: bool) -> Iterator[Import]:
            for child in ast.iter_child_nodes(node):
                for target, names in self._targets(child, module):
                    yield Import(module, target, names, late, self.line(module, child))
                typing = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)
                inside = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
                yield from walk(child, late or typing or inside)

        yield from walk(self.trees[module], False)

    def _targets(self, node: ast.AST, module: str) -> Iterator[tuple[str, tuple[str, ...]]]:
        if isinstance(node, ast.Import):
            for a in node.names:
                yield self._below(a.name), ()
        elif isinstance(node, ast.ImportFrom):
            base = self._below(self._absolute(node, module))
            for a in node.names:
                inner = a.name if base == "." else f"{base}.{a.name}"
                yield (inner, ()) if inner in self.files else (base, (a.name,))

    def _absolute(self, node: ast.ImportFrom, module: str) -> str:
        if not node.level:
            return node.module or ""
        parts = self.name.split(".") + ([] if module == "." else module.split("."))
        kept = parts[:len(parts) - node.level + (self.files[module].name == "__init__.py")]
        return ".".join([*kept, *([node.module] if node.module else [])])

    def _below(self, name: str) -> str:
        return "." if name == self.name else name.removeprefix(f"{self.name}.")

    @cached_property
    def functions(self) -> list[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef]]:
        """Module and node of every function, method and class."""
        kinds = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
        return [(m, n) for m, tree in self.trees.items() for n in ast.walk(tree) if isinstance(n, kinds)]


# -- the rules: each returns what breaks it ----------------------------------------------------------------
def layers(house: House) -> list[str]:
    """Every room has a layer, and imports go up the list only."""
    level = {room: k for k, row in enumerate(LAYERS) for room in row.split()}
    rooms = {house.room(m) for m in house.files}
    lost = [f"{room}: give it a layer" for room in sorted(rooms - set(level))]
    wrong = [f"{i.line}: {i.source} imports {i.target}" for i in house.inner
             if (a := house.room(i.source)) != (b := house.room(i.target))
             and level.get(a, 99) <= level.get(b, -1)]
    return lost + wrong


def knowledge(house: House) -> list[str]:
    """Rooms that stand by themselves know no more than `KNOWS` lets them."""
    return [f"{i.line}: {i.source} imports {i.target}" for i in house.inner
            if (room := house.room(i.source)) in KNOWS and house.room(i.target) != room
            and not any(f"{i.target}.".startswith(f"{known}.") for known in KNOWS[room])]


def circles(house: House) -> list[str]:
    """No file imports itself by way of others, late and typing imports included."""
    edges: dict[str, set[str]] = {}
    for i in house.inner:
        edges.setdefault(i.source, set()).add(i.target)
    found, done = [], set()

    def visit(module: str, way: tuple[str, ...]) -> None:
        if module in way:
            found.append(" -> ".join([*way[way.index(module):], module]))
        elif module not in done:
            for other in sorted(edges.get(module, ())):
                visit(other, (*way, module))
            done.add(module)

    for module in sorted(edges):
        visit(module, ())
    return found


def hall(house: House) -> list[str]:
    """At the root stand only the files that belong there."""
    files = {p.name for p in house.folder.iterdir() if p.is_file() and p.suffix != ".pyc"}
    return [f"{name}: into a room" for name in sorted(files - ROOT_FILES)] + [
        f"{name}: missing" for name in sorted(ROOT_FILES - files)]


def homes(house: House) -> list[str]:
    """A heavy library is imported in its home alone; rich, which needs a terminal to be of use, late."""
    found = []
    for i in house.imports:
        home = HOMES.get(i.target.split(".")[0])
        if home and not any(f"{i.source}.".startswith(f"{h}.") for h in home.split()):
            found.append(f"{i.line}: {i.source} imports {i.target}")
        if i.target.split(".")[0] == "rich" and not i.late:
            found.append(f"{i.line}: {i.source} imports {i.target} early")
    return found


def shadows(house: House) -> list[str]:
    """No name that a package hands on hides a module of its own."""
    found = []
    for module, path in house.files.items():
        if path.name == "__init__.py":
            names = {a.asname or a.name: n for n in ast.walk(house.trees[module])
                     if isinstance(n, ast.ImportFrom) for a in n.names}
            names |= {n.name: n for n in house.trees[module].body if isinstance(n, ast.FunctionDef | ast.ClassDef)}
            for name, node in names.items():
                below = name if module == "." else f"{module}.{name}"
                if below in house.files and not _imports_module(house, module, node, below):
                    found.append(f"{house.line(module, node)}: '{name}' hides the module {below}")
    return found


def _imports_module(house: House, module: str, node: ast.AST, below: str) -> bool:
    return any(target == below for target, _ in house._targets(node, module))


def faces(house: House) -> list[str]:
    """A room's `__init__` is a docstring; some hand names on."""
    return [f"{path.relative_to(house.folder)}: more than a docstring" for module, path in house.files.items()
            if path.name == "__init__.py" and module not in FACES
            and (len(house.trees[module].body) != 1 or ast.get_docstring(house.trees[module]) is None)]


def private_names(house: House) -> list[str]:
    """Nothing outside a class reads its private names, and no file imports another's."""
    defined = {n for m, node in house.functions if isinstance(node, ast.ClassDef) for n in _private(node)}
    found = [f"{i.line}: imports {n} of {i.target}" for i in house.inner for n in i.names
             if n.startswith("_") and not n.startswith("__")]

    def walk(module: str, node: ast.AST, own: frozenset[str]) -> None:
        for child in ast.iter_child_nodes(node):
            inside = own | _private(child) if isinstance(child, ast.ClassDef) else own
            if isinstance(child, ast.Attribute) and child.attr in defined - own and not _is_self(child.value):
                found.append(f"{house.line(module, child)}: {ast.unparse(child)}")
            walk(module, child, inside)

    for module, tree in house.trees.items():
        walk(module, tree, frozenset())
    return found


def _private(node: ast.ClassDef) -> frozenset[str]:
    """Private methods, fields and attributes of a class."""
    names = {n.name for n in node.body if isinstance(n, ast.FunctionDef)}
    names |= {n.target.id for n in node.body if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)}
    names |= {n.attr for n in ast.walk(node) if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store)
              and _is_self(n.value)}
    return frozenset(n for n in names if n.startswith("_") and not n.startswith("__"))


def _is_self(node: ast.AST) -> bool:
    return isinstance(node, ast.Name) and node.id in ("self", "cls")


def names(house: House) -> list[str]:
    """Modules and functions are called by terms of the field ("held out" is one)."""
    found = [f"{house.files[m].relative_to(house.folder)}: name" for m in house.files if _moods(m.split(".")[-1])]
    return found + [f"{house.line(m, n)}: {n.name}" for m, n in house.functions if _moods(n.name)]


def _moods(name: str) -> set[str]:
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower().replace("held_out", "").split("_")
    return MOODS & set(words)


def long_functions(house: House) -> list[str]:
    """A function is no longer than a page."""
    return [f"{house.line(m, n)}: {n.name} has {length} lines of code" for m, n in house.functions
            if not isinstance(n, ast.ClassDef) and (length := _lines_of_code(n)) > LONGEST_FUNCTION]


def _lines_of_code(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    first = node.body[0]
    doc = ast.get_docstring(node, clean=False) is not None
    return (node.end_lineno or 0) - node.lineno + 1 - (((first.end_lineno or 0) - first.lineno + 1) if doc else 0)


def size(house: House) -> list[str]:
    """So many files and lines."""
    lines = sum(len(p.read_text(encoding="utf-8").splitlines()) for p in house.files.values())
    return [f"{n} {what}, at most {most}" for n, what, most in
            ((len(house.files), "files", MOST_FILES), (lines, "lines", MOST_LINES)) if n > most]


RULES = (layers, knowledge, circles, hall, homes, shadows, faces, private_names, names, long_functions, size)


# -- the package -------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def package() -> House:
    house = House(Path(motorid.__file__).parent)
    assert len(house.inner) > 200, "the reading of imports must not come up empty"
    return house


@pytest.mark.parametrize("rule", RULES, ids=lambda r: r.__name__)
def test_the_package_keeps_the_rule(package, rule: Callable[[House], list[str]]):
    assert rule(package) == []


def test_there_are_few_layers():
    assert len(LAYERS) <= MOST_LAYERS
    rooms = " ".join(LAYERS).split()
    assert len(rooms) == len(set(rooms))


@pytest.mark.parametrize("work", ["", "mi.fit(mi.dc_motor(), mi.read_runs(mi.data_path('two_step_noisy')));"],
                         ids=["import", "first fit"])
def test_importing_motorid_and_a_first_fit_load_nothing_heavy(tmp_path, work):
    late = [m for m in LATE if not work or m != "threadpoolctl"]
    code = f"import sys, motorid as mi; {work} print([m for m in {late!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120,
                          check=True)
    assert done.stdout.strip() == "[]"


def test_the_data_makers_know_nothing_of_the_models(package):
    """The plant that makes the shipped records must not share code with what is tested on them."""
    data = next(d for d in (package.folder.parent / "data", package.folder / "data") if (d / "plant").is_dir())
    files = [*data.glob("*.py"), *data.glob("plant/*.py")]
    assert len(files) > 3
    for path in files:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            found = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            found += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            assert not [n for n in found if n.split(".")[0] == "motorid"], path.name


def test_tests_and_benchmarks_run_with_the_threads_that_a_user_has():
    """The package holds its own small problems to one thread; what a shell sets would hide where it does not."""
    setting = re.compile(r"\b(OPENBLAS|OMP|MKL|VECLIB|BLIS|NUMEXPR)_NUM_" + "THREADS")
    folder = Path(__file__).parent
    files = [*folder.rglob("*.py"), folder.parent / "pyproject.toml"]
    assert len(files) > 50
    assert [str(p.relative_to(folder.parent)) for p in files if setting.search(p.read_text(encoding="utf-8"))] == []


# -- the rules themselves, on a house of two rooms that keeps them until it is broken -----------------------
SOUND = {
    "__init__.py": '"""A house."""\nfrom house.problem.problem import Problem\n',
    "__main__.py": '"""Door."""\nfrom house.cli.app import main\nmain()\n',
    "py.typed": "",
    "errors.py": '"""Errors."""\n',
    "channels.py": '"""Channels."""\n',
    "numerics/__init__.py": '"""Algorithms."""\n',
    "numerics/signals.py": '"""Signals."""\nfrom house.errors import E\n',
    "problem/__init__.py": '"""A problem."""\n',
    "problem/problem.py": '"""P."""\nfrom house.numerics.signals import f\n'
                          "class Problem:\n    def _own(self, other):\n        return other._own(self)\n",
    "cli/__init__.py": '"""Commands."""\nfrom house.cli.app import main\n',
    "cli/app.py": '"""App."""\nimport typer\ndef main():\n    import rich\n',
}
LONG = "def f():\n" + "    x = 1\n" * (LONGEST_FUNCTION + 1)
BROKEN = (
    (layers, "numerics/signals.py", "def f():\n    from house.problem import problem\n"),
    (layers, "records/x.py", "import house.model.y\n"),
    (layers, "attic/x.py", ""),
    (knowledge, "numerics/signals.py", "from ..channels import CHANNELS\n"),
    (circles, "problem/runs.py", "if TYPE_CHECKING:\n    from house.problem import y\n"),
    (circles, "errors.py", "def f():\n    from house import Problem\n"),
    (hall, "helpers.py", ""),
    (homes, "problem/problem.py", "def f():\n    import matplotlib.pyplot as plt\n"),
    (homes, "cli/app.py", "import rich\n"),
    (shadows, "__init__.py", "from house.errors import problem\n"),
    (shadows, "cli/__init__.py", "def app():\n    pass\n"),
    (faces, "problem/__init__.py", '"""A problem."""\nfrom house.problem.problem import Problem\n'),
    (private_names, "cli/app.py", "def f(problem):\n    return problem._own\n"),
    (private_names, "problem/runs.py", "class Run:\n    def f(self, problem):\n        return problem._own(1)\n"),
    (private_names, "problem/runs.py", "from house.numerics.signals import _f\n"),
    (names, "problem/beginning.py", ""),
    (names, "problem/runs.py", "def descend_surely():\n    pass\n"),
    (names, "problem/runs.py", "class HardlyMoved:\n    pass\n"),
    (long_functions, "problem/runs.py", LONG),
    (size, "problem/runs.py", "\n" * (MOST_LINES + 1)),
)


def built(folder: Path, files: dict[str, str]) -> House:
    for name, text in files.items():
        path = folder / "house" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return House(folder / "house")


def test_a_sound_house_breaks_no_rule(tmp_path):
    house = built(tmp_path, SOUND)
    assert {rule.__name__: rule(house) for rule in RULES} == {rule.__name__: [] for rule in RULES}


@pytest.mark.parametrize(("rule", "file", "text"), BROKEN, ids=lambda x: getattr(x, "__name__", ""))
def test_a_broken_house_breaks_the_rule(tmp_path, rule, file, text):
    more = {"problem/y.py": "import house.problem.runs\n"} if rule is circles and "runs" in file else {}
    more |= {"model/y.py": ""} if "model" in text else {}
    assert rule(built(tmp_path, {**SOUND, **more, file: text}))


def test_what_is_right_is_not_taken_for_wrong(tmp_path):
    """Held out is a term; a docstring is no code; a private name of the class itself is its own."""
    text = 'def held_out():\n    """' + "\n" * (LONGEST_FUNCTION + 5) + '    """\n    return 1\n'
    house = built(tmp_path, {**SOUND, "problem/runs.py": text})
    assert names(house) == long_functions(house) == private_names(house) == []
