"""Imports point one way through the rooms of the package, and `import dirax` brings in nothing it does not need."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "dirax"

# A module may import from its own room and from those before it. "__init__" is the package itself: its public names.
ROOMS = (
    "text",
    "program",
    "geometry",
    "systems",
    "reduction",
    "schemes",
    "engines",
    "solution",
    "run",
    "diagnostics",
    "gallery",
    "__init__",
    "cli",
)
RANK = {room: rank for rank, room in enumerate(ROOMS)}
LOADED_ON_DEMAND = ("matplotlib", "xarray", "zarr", "h5netcdf", "pandas", "typer", "rich")


def room_of(path: Path) -> str:
    """The room that a file of the package belongs to: its top folder, or its own name."""
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def imported_rooms(path: Path, source: str) -> list[tuple[int, str]]:
    """(line, room) of every import of dirax in a file, at module level or inside a function, absolute or relative."""
    found = []
    package = ("dirax", *path.relative_to(SOURCE).parts[:-1])
    for node in ast.walk(ast.parse(source)):
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


def test_importing_dirax_loads_no_plotting_storage_or_command_line_library():
    program = f"import sys, dirax; print(*(name for name in {LOADED_ON_DEMAND} if name in sys.modules))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == []
