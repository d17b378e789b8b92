"""Imports point one way through the rooms of the package, and `import dirax` brings in nothing it does not need."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "dirax"

# A module may import from its own room and from those before it. "__init__" is the package itself: its public names.
ROOMS = (
    "interruption",
    "float64",
    "text",
    "numerics",
    "program",
    "geometry",
    "systems",
    "reduction",
    "schemes",
    "engines",
    "solution",
    "run",
    "diagnostics",
    "sweeps",
    "show",
    "bodies",
    "gallery",
    "public",
    "__init__",
    "cli",
    "__main__",
)
RANK = {room: rank for rank, room in enumerate(ROOMS)}
LOADED_ON_DEMAND = ("matplotlib", "xarray", "zarr", "h5netcdf", "h5py", "pandas", "typer", "rich", "distributed")


@functools.cache
def nodes_of(source: str) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(ast.parse(source)))


def room_of(path: Path) -> str:
    """The room that a file of the package belongs to: its top folder, or its own name."""
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def imported_rooms(path: Path, source: str) -> list[tuple[int, str]]:
    """(line, room) of every import of dirax in a file, at module level or inside a function, absolute or relative."""
    found = []
    package = ("dirax", *path.relative_to(SOURCE).parts[:-1])
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*above, *filter(None, [node.module])))
            # `from dirax import x` is an import of the room x if there is one, else of the package's public names.
            targets = [f"{module}.{alias.name}" for alias in node.names] if module == "dirax" else [module]
        else:
            continue
        for target in targets:
            root, _, rest = target.partition(".")
            if root == "dirax":
                name = rest.partition(".")[0]
                is_room = (SOURCE / name).is_dir() or (SOURCE / f"{name}.py").is_file()
                found.append((node.lineno, name if name and is_room else "__init__"))
    return found


def against_the_order(path: Path, source: str) -> list[str]:
    room = room_of(path)
    return [
        f"{path.relative_to(SOURCE)}:{line} imports {imported}, which does not come before {room}"
        for line, imported in imported_rooms(path, source)
        if RANK.get(imported, -1) > RANK.get(room, len(ROOMS))
    ]


def test_every_module_has_a_room():
    names = {room_of(path) for path in SOURCE.rglob("*.py")}
    assert names <= RANK.keys(), f"give these a place in ROOMS: {sorted(names - RANK.keys())}"


def test_imports_point_one_way():
    wrong = [line for path in sorted(SOURCE.rglob("*.py")) for line in against_the_order(path, path.read_text("utf-8"))]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "source",
    [
        "import dirax.gallery",
        "import numpy, dirax.engines as e",
        "from dirax.schemes import step",
        "from dirax.schemes.step import StepEquation",
        "from dirax import engines",
        "from dirax.run.simulate import simulate",
        "from dirax import LagrangeDirac",
        "import dirax as dx",
        "from ..schemes.step import StepEquation",
        "from .. import cli",
        "from .. import __version__",
        "def late():\n    from dirax.schemes.step import StepEquation",
    ],
)
def test_an_import_against_the_order_is_found(source):
    assert len(against_the_order(SOURCE / "systems" / "some_system.py", source)) == 1


@pytest.mark.parametrize(
    "source",
    ["import jax", "from dirax.geometry import maps", "from ..geometry.maps import Theta", "from . import other"],
)
def test_an_import_along_the_order_is_not(source):
    assert against_the_order(SOURCE / "systems" / "some_system.py", source) == []


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__") or "__init__"


def imported_modules(path: Path, source: str, modules: set[str]) -> set[str]:
    """The modules that a file imports, anywhere in it: also inside functions and for type checkers only."""
    found = set()
    package = ("dirax", *path.relative_to(SOURCE).parts[:-1])
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            targets = [(alias.name, None) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            targets = [(".".join((*above, *filter(None, [node.module]))), alias.name) for alias in node.names]
        else:
            continue
        for target, name in targets:
            root, _, module = target.partition(".")
            if root == "dirax":
                inner = f"{module}.{name}".removeprefix(".")
                found.add(inner if name and inner in modules else module or "__init__")
    return found & modules


def circles(imports: dict[str, set[str]]) -> list[set[str]]:
    """The strongly connected components of more than one module (Tarjan)."""
    number, low, stack, found = {}, {}, [], []

    def visit(module: str) -> None:
        number[module] = low[module] = len(number)
        stack.append(module)
        for other in imports[module]:
            if other not in number:
                visit(other)
            if other in stack:
                low[module] = min(low[module], low[other])
        if low[module] == number[module]:
            component = set(stack[stack.index(module) :])
            del stack[stack.index(module) :]
            if len(component) > 1:
                found.append(component)

    for module in imports:
        if module not in number:
            visit(module)
    return found


def test_no_circle_of_modules():
    paths = {module_of(path): path for path in SOURCE.rglob("*.py")}
    imports = {name: imported_modules(path, path.read_text("utf-8"), paths.keys()) - {name} for name, path in paths.items()}
    found = circles(imports)
    assert not found, "\n".join(", ".join(sorted(circle)) for circle in found)


@pytest.mark.parametrize(
    "source",
    [
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from dirax.run.start import begin",
        "def late():\n    import dirax.run.start",
        "from dirax.run import start",
        "from . import start",
        "from .start import begin",
    ],
)
def test_a_circle_is_found(source):
    path = SOURCE / "run" / "simulate.py"
    modules = {"run.simulate", "run.start", "run", "__init__"}
    imports = {"run.simulate": imported_modules(path, source, modules), "run.start": {"run.simulate"}}
    assert circles({"run": set(), "__init__": set(), **imports}) == [{"run.simulate", "run.start"}]


def answer(program: str) -> str:
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return run.stdout.strip()


def test_importing_dirax_loads_no_plotting_storage_or_command_line_library():
    public = f"import sys, dirax; dirax.simulate; print(*(name for name in {LOADED_ON_DEMAND} if name in sys.modules))"
    assert answer(public) == ""


def test_importing_dirax_loads_nothing_until_a_name_is_used():
    program = "import sys, dirax; print('jax' in sys.modules, 'numpy' in sys.modules); dirax.Theta; print('jax' in sys.modules)"
    assert answer(program).split() == ["False", "False", "True"]


@pytest.mark.parametrize("order", ["import jax, dirax", "import dirax, jax"])
def test_importing_dirax_turns_on_64_bits_in_whatever_order(order):
    program = f"{order}; import jax.numpy as jnp; print(jnp.zeros(1).dtype, jax.__spec__.loader is jax.__loader__)"
    assert answer(program).split() == ["float64", "True"]


def test_public_names():
    import dirax
    from dirax import public

    assert len(set(public.__all__)) == len(public.__all__) >= 93
    assert all(getattr(dirax, name) is getattr(public, name) for name in public.__all__)
    assert set(public.__all__) == {name for name in dir(dirax) if not name.startswith("_")} and dirax.__all__ is public.__all__
    imported = {
        alias.name
        for node in ast.parse(Path(public.__file__).read_text("utf-8")).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert imported == set(public.__all__)
    assert dirax.gallery.names() and dirax.geometry.maps.Theta is dirax.Theta
    with pytest.raises(AttributeError, match="module 'dirax' has no attribute 'Nonsense'"):
        _ = dirax.Nonsense
