"""The house rules: who imports whom, who knows which library, what an import may cost, how long things may be.

Each test names all offenders at once.
"""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "meshmatch"

# From the ground up: a room imports itself and what stands before it. `experiments` measures what `api` composes.
GROUND = ("errors", "scalars", "threads", "batching", "derived", "blender", "outputs", "locks", "progress")
ROOMS = (
    *GROUND,
    *("arrays", "geometry", "shapes", "templates", "generators", "fields", "models", "training", "fitting"),
    *("maps", "implicit", "transfer", "render", "api", "collections", "cli", "__main__", "experiments"),
)

# The floors of `fitting`, from the ground up: settings and progress of a fit, what is solved, what is searched, what is
# judged, and the result. What is not named here composes them, and stands above.
FITTING = ("fit_config", "solve", "search", "judge", "fit")

# Which rooms know which third-party library.
OWNERS = {
    "DracoPy": {"shapes"},
    "PIL": {"shapes", "maps", "transfer", "render", "experiments"},
    "anny": {"generators"},
    "distributed": {"collections"},
    "embreex": {"render"},
    "fast_simplification": {"shapes"},
    "filelock": {"locks"},
    "fsspec": {"collections"},
    "jaxtyping": {"arrays"},
    "matplotlib": {"render"},
    "meshmonk": {"experiments"},
    "meshoptimizer": {"shapes"},
    "platformdirs": {"outputs", "experiments"},
    "pyFM": {"experiments"},
    "pydantic": {"models"},
    "pymeshlab": {"shapes"},
    "rich": {"experiments", "cli"},
    "robust_laplacian": {"templates", "fitting", "maps"},
    "safetensors": {"maps", "templates", "generators", "models", "training"},
    "scipy": {
        *(
            "fields",
            "geometry",
            "shapes",
            "templates",
            "generators",
            "models",
            "training",
            "fitting",
            "maps",
            "implicit",
            "transfer",
            "render",
            "api",
            "collections",
        ),
        "experiments",
    },
    "skimage": {"implicit", "experiments"},
    "tensorboard": {"training"},
    "threadpoolctl": {"threads"},
    "torch": {"arrays", "generators", "fields", "models", "training", "fitting", "implicit", "experiments"},
    "trimesh": {"shapes", "fitting", "experiments"},
    "typer": {"cli", "experiments"},
}
DISTRIBUTIONS = {
    "PIL": "pillow",
    "fast_simplification": "fast-simplification",
    "pyFM": "pyfmaps",
    "robust_laplacian": "robust-laplacian",
    "skimage": "scikit-image",
}
EXTRAS = (
    "meshlab",
    "compressed",
    "train",
    "implicit",
    "cluster",
    "tensorboard",
    "bench",
    "plots",
)  # what the package imports only where it is installed
HEAVY = {"torch", "trimesh", "pymeshlab", "scipy", "safetensors", "matplotlib", "jaxtyping"}
NO_TORCH = ("geometry", "shapes", "templates", "maps", "transfer", "render")
FORBIDDEN_NAMES = {"utils", "util", "common", "helpers", "helper", "base", "misc"}


class Import(NamedTuple):
    name: str  # a module, or a module and a name in it
    at_load: bool


@cache
def trees() -> dict[str, ast.Module]:
    """Every module of the package by its dotted name, without what runs inside Blender."""
    found = {}
    for path in sorted(path for path in PACKAGE.rglob("*.py") if "_blender" not in path.parts):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = ast.parse(path.read_text(encoding="utf-8"), str(path))
    return found


def room_of(module: str) -> str:
    """The first part of a module's name below the package; "" for the package's own file."""
    return module.partition(".")[2].partition(".")[0]


@cache
def imports(tree: ast.Module) -> tuple[Import, ...]:
    """Everything imported, and whether the import runs when the module is loaded."""
    inside = {
        id(node)
        for outer in ast.walk(tree)
        if isinstance(outer, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        or (isinstance(outer, ast.If) and "TYPE_CHECKING" in ast.unparse(outer.test))
        for node in ast.walk(outer)
    }
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [Import(alias.name, id(node) not in inside) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            found += [Import(f"{node.module}.{alias.name}", id(node) not in inside) for alias in node.names]
    return tuple(found)


def downward(room: str, tree: ast.Module) -> list[str]:
    """Imports of a module in `room` of rooms that stand after it."""
    bad = []
    for name, _ in imports(tree):
        other = room_of(name)
        ours = name.split(".")[0] == "meshmatch" and other not in ("", "__version__")
        if ours and (other not in ROOMS or ROOMS.index(other) > ROOMS.index(room)):
            bad.append(name)
    return bad


def floor_of(module: str) -> int:
    """Of a module of `fitting`."""
    name = module.split(".")[2] if module.count(".") > 1 else ""
    return FITTING.index(name) if name in FITTING else len(FITTING)


def down_the_stairs(module: str, tree: ast.Module) -> list[str]:
    """Imports of a module of `fitting` from a floor above its own."""
    names = [name for name, _ in imports(tree) if name.startswith("meshmatch.fitting.")]
    return [name for name in names if floor_of(name) > floor_of(module)]


def third_party(tree: ast.Module) -> set[str]:
    names = {name.split(".")[0] for name, _ in imports(tree)}
    return names - set(sys.stdlib_module_names) - {"meshmatch", "numpy"}


def circles(modules: dict[str, ast.Module]) -> list[str]:
    """Modules that import each other, whether when loaded or inside functions."""
    edges: dict[str, set[str]] = {}
    for module, tree in modules.items():
        targets = set()
        for name, _ in imports(tree):
            target = name if name in modules else name.rpartition(".")[0]
            if target in modules and target not in (module, "meshmatch"):
                targets.add(target)
        edges[module] = targets
    while True:  # what imports nothing that is left, or is imported by nothing that is left, is in no circle
        imported = set().union(*edges.values()) if edges else set()
        kept = {module for module, targets in edges.items() if targets and module in imported}
        if len(kept) == len(edges):
            return sorted(kept)
        edges = {module: edges[module] & kept for module in kept}


def long_modules(folder: Path, limit: int = 550) -> list[str]:
    """Modules of more lines than that: each is asking to be two."""
    lines = {path: path.read_text(encoding="utf-8").count("\n") for path in folder.rglob("*.py")}
    return [f"{path.relative_to(folder)}: {count} lines" for path, count in lines.items() if count > limit]


def loaded_by(statement: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after a statement."""
    code = f"{statement}\nimport sys\nprint(' '.join({{name.split('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


def all_modules(room: str) -> str:
    """A statement that imports every module of a room."""
    return "\n".join(f"import {module}" for module in trees() if room_of(module) == room)


def none(offenders: Iterable[str]) -> None:
    """There are no offenders; otherwise all of them are named."""
    found = sorted(offenders)
    assert not found, "\n".join(["", *found])


def test_every_module_stands_in_a_room() -> None:
    assert {room_of(module) for module in trees()} - {""} <= set(ROOMS)


def test_imports_point_up() -> None:
    rooms = {module: tree for module, tree in trees().items() if room_of(module)}
    none(f"{module}: {bad}" for module, tree in rooms.items() for bad in downward(room_of(module), tree))


def test_the_rule_sees_an_import_that_points_down() -> None:
    def asked(room: str, source: str) -> list[str]:
        return downward(room, ast.parse(source))

    assert asked("shapes", "from meshmatch.fitting.fit import Fit") == ["meshmatch.fitting.fit.Fit"]
    assert asked("fitting", "def f():\n    import meshmatch.maps.build") == ["meshmatch.maps.build"]
    assert asked("maps", "from meshmatch import api") == ["meshmatch.api"]
    assert asked("maps", "from meshmatch.fitting.fit import Fit") == []


def test_a_fit_is_searched_solved_and_judged_in_one_direction() -> None:
    rooms = {module: tree for module, tree in trees().items() if module.startswith("meshmatch.fitting.")}
    assert {module.split(".")[2] for module in rooms} >= set(FITTING)
    none(f"{module}: {bad}" for module, tree in rooms.items() for bad in down_the_stairs(module, tree))


def test_the_rule_sees_a_search_that_judges() -> None:
    tree = ast.parse("from meshmatch.fitting.judge.verdict import judge\nfrom meshmatch.fitting.solve.system import x")
    assert down_the_stairs("meshmatch.fitting.search.task", tree) == ["meshmatch.fitting.judge.verdict.judge"]
    assert down_the_stairs("meshmatch.fitting.fitter", tree) == []


def test_no_module_imports_in_a_circle() -> None:
    none(circles(trees()))


def test_the_rule_sees_a_circle() -> None:
    sources = {
        "p.a": "from p.b import x",
        "p.b": "def f():\n    from p import c",
        "p.c": "import p.a, p.d",
        "p.d": "import os",
        "p.e": "import p.a",
    }
    assert circles({name: ast.parse(source) for name, source in sources.items()}) == ["p.a", "p.b", "p.c"]


def test_a_library_is_known_by_its_owners_alone() -> None:
    found = ((module, name) for module, tree in trees().items() for name in sorted(third_party(tree)))
    strangers = [f"{module}: {name}" for module, name in found if room_of(module) not in OWNERS.get(name, set())]
    none(strangers)


def test_the_ground_is_standard_library_alone_when_loaded() -> None:
    for room in GROUND:
        for tree in (tree for module, tree in trees().items() if room_of(module) == room):
            names = {name.split(".")[0] for name, at_load in imports(tree) if at_load}
            assert names <= set(sys.stdlib_module_names) | {"meshmatch"}, room


def test_pymeshlab_is_known_by_one_module_and_only_when_asked() -> None:
    found = {
        (module, each.at_load)
        for module, tree in trees().items()
        for each in imports(tree)
        if each.name.split(".")[0] == "pymeshlab"
    }
    assert found == {("meshmatch.shapes.decimate", False)}


def bare(requirements: Iterable[str]) -> set[str]:
    return {re.split(r"[<>=!~\[; ]", item)[0] for item in requirements}


def test_dependencies_are_those_that_are_imported() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    used = {DISTRIBUTIONS.get(name, name) for name in set().union(*map(third_party, trees().values()))} | {"numpy"}
    core = bare(project["dependencies"])
    optional = bare(item for extra in EXTRAS for item in project["optional-dependencies"].get(extra, ()))
    assert used == core | optional
    assert core & optional == set()


def test_no_drawer_without_a_name() -> None:
    assert {part for module in trees() for part in module.split(".")} & FORBIDDEN_NAMES == set()


def test_no_module_is_too_long() -> None:
    none(long_modules(PACKAGE))


def test_the_rule_sees_a_module_that_is_too_long(tmp_path: Path) -> None:
    (tmp_path / "fine.py").write_text("a = 1\n" * 550)
    (tmp_path / "long.py").write_text("a = 1\n" * 551)
    assert long_modules(tmp_path) == ["long.py: 551 lines"]


@pytest.mark.parametrize(
    "statement",
    [
        "import meshmatch.cli.app, meshmatch.models.registry, meshmatch.models.card",
        "import contextlib, io\n"
        "from meshmatch.cli import main\n"
        "with contextlib.redirect_stdout(io.StringIO()): main(['--help'])",
    ],
    ids=["commands and cards", "--help"],
)
def test_light_modules_load_nothing_heavy(statement: str) -> None:
    assert loaded_by(statement) & (HEAVY | {"numpy", "rich"}) == set()


def test_what_needs_no_network_loads_no_torch() -> None:
    """Nobody waits for it, or for another heavy library that not every call needs, to carry a map or draw."""
    found = loaded_by("\n".join(all_modules(room) for room in NO_TORCH))
    none(found & {"torch", "matplotlib", "trimesh", "pymeshlab"})


def test_a_match_loads_no_tools_of_other_libraries() -> None:
    """Annotations need no jaxtyping when they run."""
    none(loaded_by("import meshmatch.maps.vertex_map, meshmatch.api.matching") & {"jaxtyping", "torch"})


def test_the_interpreter_test_sees_a_heavy_import() -> None:
    assert "scipy" in loaded_by("import meshmatch.maps.geodesics")
