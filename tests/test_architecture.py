"""The house rules: who imports whom, who knows which library, what an import may cost."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "meshmatch"

# From the ground up. A room imports itself and what stands before it. `interpolation` takes its shapes the pipeline's
# way, and `experiments` measures the pipeline: both stand after it.
ROOMS = (
    *("errors", "threads", "outputs", "progress"),
    *(
        "shapes",
        "templates",
        "fields",
        "models",
        "training",
        "fitting",
        "maps",
        "transfer",
        "render",
        "collections",
    ),
    *("pipeline", "interpolation", "experiments", "cli", "__main__"),
)
GROUND = ("errors", "threads", "outputs", "progress")

# Which rooms know which third-party library.
OWNERS = {
    "PIL": {"shapes", "maps", "transfer", "render"},
    "anny": {"training"},
    "embreex": {"render"},
    "fast_simplification": {"shapes"},
    "meshmonk": {"experiments"},
    "platformdirs": {"models", "training", "experiments"},
    "pyFM": {"experiments"},
    "pymeshlab": {"shapes"},
    "rich": {"experiments", "cli"},
    "robust_laplacian": {"templates", "maps"},
    "safetensors": {"templates", "models", "training"},
    "scipy": {
        *("shapes", "templates", "models", "training", "fitting", "maps", "transfer", "render"),
        "experiments",
    },
    "torch": {"fields", "models", "training", "fitting", "experiments"},
    "trimesh": {"shapes", "experiments"},
    "typer": {"cli"},
    "xatlas": {"transfer"},
}
DISTRIBUTIONS = {
    "PIL": "pillow",
    "fast_simplification": "fast-simplification",
    "pyFM": "pyfmaps",
    "robust_laplacian": "robust-laplacian",
}
HEAVY = ("torch", "trimesh", "pymeshlab", "scipy", "safetensors")
FORBIDDEN_NAMES = {"utils", "util", "common", "helpers", "helper", "base", "misc"}


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str:
    """The first part of a module's name below the package; "" for the package's own file."""
    first = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    return "" if first == "__init__" else first


def imports(source: str) -> Iterator[tuple[str, bool]]:
    """Every imported module's full name, and whether the import runs when the module is loaded."""
    tree = ast.parse(source)
    inside = {
        id(node)
        for outer in ast.walk(tree)
        if isinstance(outer, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        or (isinstance(outer, ast.If) and "TYPE_CHECKING" in ast.unparse(outer.test))
        for node in ast.walk(outer)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, id(node) not in inside) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            assert node.module is not None
            if node.module == "meshmatch":  # `from meshmatch import pipeline` names a room
                yield from ((f"meshmatch.{alias.name}", id(node) not in inside) for alias in node.names)
            else:
                yield node.module, id(node) not in inside


def downward(room: str, source: str) -> list[str]:
    """Imports of `source`, in `room`, of rooms that stand after it."""
    bad = []
    for name, _ in imports(source):
        parts = name.split(".")
        if parts[0] != "meshmatch" or len(parts) == 1 or parts[1] == "__version__":
            continue
        if parts[1] not in ROOMS or ROOMS.index(parts[1]) > ROOMS.index(room):
            bad.append(name)
    return bad


def third_party(source: str) -> set[str]:
    names = {name.split(".")[0] for name, _ in imports(source)}
    return names - set(sys.stdlib_module_names) - {"meshmatch", "numpy"}


def test_every_module_stands_in_a_room() -> None:
    assert {room_of(path) for path in modules()} - {""} <= set(ROOMS)


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_up(path: Path) -> None:
    room = room_of(path)
    source = path.read_text(encoding="utf-8")
    if not room:
        assert [name for name, _ in imports(source) if name.startswith("meshmatch")] == []
    else:
        assert downward(room, source) == []


def test_the_rule_sees_an_import_that_points_down() -> None:
    assert downward("shapes", "from meshmatch.fitting.fit import Fit") == ["meshmatch.fitting.fit"]
    assert downward("fitting", "def f():\n    import meshmatch.maps.build") == ["meshmatch.maps.build"]
    assert downward("maps", "from meshmatch import pipeline") == ["meshmatch.pipeline"]
    assert downward("maps", "from meshmatch.fitting.fit import Fit") == []


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_library_is_known_by_its_owners_alone(path: Path) -> None:
    room = room_of(path)
    found = third_party(path.read_text(encoding="utf-8"))
    assert {name for name in found if room not in OWNERS.get(name, set())} == set()


@pytest.mark.parametrize("room", GROUND)
def test_the_ground_is_standard_library_alone(room: str) -> None:
    names = {name.split(".")[0] for name, _ in imports((PACKAGE / f"{room}.py").read_text(encoding="utf-8"))}
    assert names <= set(sys.stdlib_module_names) | {"meshmatch"}


def test_pymeshlab_is_known_by_one_module_and_only_when_asked() -> None:
    found = {
        (path.name, at_load)
        for path in modules()
        for name, at_load in imports(path.read_text(encoding="utf-8"))
        if name.split(".")[0] == "pymeshlab"
    }
    assert found == {("pymeshlab_filters.py", False)}


def test_dependencies_are_those_that_are_imported() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

    def bare(requirements: list[str]) -> set[str]:
        return {re.split(r"[<>=!~\[; ]", item)[0] for item in requirements}

    extras = project["optional-dependencies"]
    used = set().union(*(third_party(path.read_text(encoding="utf-8")) for path in modules()))
    used = {DISTRIBUTIONS.get(name, name) for name in used} | {"numpy"}
    optional = bare(extras["meshlab"]) | bare(extras["bodies"]) | bare(extras["bench"])
    assert bare(project["dependencies"]) == used - optional
    assert optional <= used


def test_no_drawer_without_a_name() -> None:
    names = {part.removesuffix(".py") for path in modules() for part in path.relative_to(PACKAGE).parts}
    assert names & FORBIDDEN_NAMES == set()


def long_modules(folder: Path, most: int = 320) -> list[str]:
    """Modules of more than `most` lines: each is asking to be two."""
    lines = {path: path.read_text(encoding="utf-8").count("\n") for path in folder.rglob("*.py")}
    return [f"{path.relative_to(folder)}: {count} lines" for path, count in lines.items() if count > most]


def test_no_module_is_too_long() -> None:
    assert long_modules(PACKAGE) == []


def test_the_rule_sees_a_module_that_is_too_long(tmp_path: Path) -> None:
    (tmp_path / "fine.py").write_text("a = 1\n" * 320)
    (tmp_path / "long.py").write_text("a = 1\n" * 321)
    assert long_modules(tmp_path) == ["long.py: 321 lines"]


def loaded_by(statement: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after a statement."""
    code = f"{statement}\nimport sys\nprint('\\n'.join({{name.split('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.split())


@pytest.mark.parametrize(
    "module",
    ["meshmatch", "meshmatch.cli", "meshmatch.cli.app", "meshmatch.models.registry", "meshmatch.models.card"],
)
def test_light_modules_load_nothing_heavy(module: str) -> None:
    assert loaded_by(f"import {module}") & {*HEAVY, "numpy", "rich"} == set()


def test_help_loads_nothing_heavy() -> None:
    statement = (
        "import contextlib, io\n"
        "from meshmatch.cli import main\n"
        "with contextlib.redirect_stdout(io.StringIO()): main(['--help'])"
    )
    assert loaded_by(statement) & {*HEAVY, "numpy", "rich"} == set()


def test_the_interpreter_test_sees_a_heavy_import() -> None:
    assert "scipy" in loaded_by("import meshmatch.maps.geodesics")
