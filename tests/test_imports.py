"""Who may import whom: the packages stay apart (docs/design.md)."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "src" / "matd3_jax"

ALLOWED = {
    "core": {"envs", "errors"},
    "envs": {"errors", "private", "thread_pool"},
    "stats": {"errors"},
}
"""Of ours, what these packages may import besides themselves; the others are free, but for `cli`."""

ONLY_IN = {
    "matplotlib": {"figures"},
    "PIL": {"video"},
    "hydra": {"config", "sweep", "cli"},
    "omegaconf": {"config", "sweep", "cli"},
}
"""Packages of others, and where alone they may be imported."""


def modules() -> dict[str, Path]:
    """Our modules by dotted name below `matd3_jax`; a package's `__init__` has the package's name."""
    found = {}
    for path in ROOT.rglob("*.py"):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def imports(path: Path, top_level: bool = False) -> Iterator[str]:
    """Dotted names that a module imports; `top_level`: those alone that are imported with it."""
    nodes = [ast.parse(path.read_text())]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: import by the whole name"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        checking = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        inner = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        if not (top_level and (inner or checking)):
            nodes += ast.iter_child_nodes(node)


def ours(path: Path, top_level: bool = False) -> set[str]:
    """The modules of ours that a module imports."""
    found = set()
    for name in imports(path, top_level):
        if name.split(".")[0] == "matd3_jax":
            inside = name.split(".")[1:]
            while inside and ".".join(inside) not in MODULES:  # the last part may be a function or a class
                inside.pop()
            found.add(".".join(inside))
    return found


def package(module: str) -> str:
    return module.split(".")[0]


@pytest.mark.parametrize("name", sorted(ALLOWED))
def test_packages_import_what_they_may(name):
    allowed = ALLOWED[name] | {name}
    found = {
        m: {o for o in ours(path) if package(o) not in allowed} for m, path in MODULES.items() if package(m) == name
    }
    assert found, name
    assert {module: names for module, names in found.items() if names} == {}


def test_nothing_imports_the_commands():
    """But for the modules that `python -m` runs."""
    run = {"train", "sweep.__main__", "evaluate", "crossplay", "plot", "render", "report", "check", "export.__main__"}
    wrong = {m for m, path in MODULES.items() if any(package(o) == "cli" for o in ours(path)) and package(m) != "cli"}
    assert wrong == run


def test_importing_the_package_loads_nothing_heavy():
    """Neither figures nor tests of significance nor simulators."""
    heavy = ("matplotlib", "scipy.stats", "brax", "mujoco", "PIL", "orbax")
    code = f"import sys; from matd3_jax import train, envs; print([name for name in {heavy} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"


@pytest.mark.parametrize("library", sorted(ONLY_IN))
def test_libraries_are_imported_where_they_belong(library):
    users = {package(m) for m, path in MODULES.items() if any(n.split(".")[0] == library for n in imports(path))}
    assert users and users <= ONLY_IN[library]


def test_private_modules_of_others_are_imported_nowhere():
    """`private` looks them up when they are needed, and says what has moved."""
    folders = [ROOT, *(ROOT.parents[1] / name for name in ("experiments", "benchmarks"))]
    paths = [path for folder in folders for path in folder.rglob("*.py")]
    found = {(path.name, name) for path in paths for name in imports(path) if not name.startswith("matd3_jax.")}
    assert len(found) > 100
    assert {pair for pair in found if any(p.startswith("_") and p[1:2] != "_" for p in pair[1].split("."))} == set()


def test_there_are_no_circles():
    """Among what modules import when they are imported."""
    graph = {module: ours(path, top_level=True) - {module} for module, path in MODULES.items()}
    done: set[str] = set()

    def visit(module: str, way: tuple[str, ...]) -> None:
        assert module not in way, " -> ".join((*way[way.index(module) :], module))
        if module not in done:
            for other in sorted(graph[module]):
                visit(other, (*way, module))
            done.add(module)

    for module in sorted(graph):
        visit(module, ())
