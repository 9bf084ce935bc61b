"""What an installed package holds: the wheel is built here and looked into."""

import email
import importlib
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from meshmatch.errors import TemplateError
from meshmatch.templates import location

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """The wheel, built without the network from this working tree."""
    folder = tmp_path_factory.mktemp("wheel")
    words = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True)
    (path,) = folder.glob("meshmatch-*.whl")
    return zipfile.ZipFile(path)


def metadata(wheel: zipfile.ZipFile) -> email.message.Message:
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    return email.message_from_bytes(wheel.read(name))


def test_the_wheel_holds_templates_weights_and_samples(wheel: zipfile.ZipFile) -> None:
    held = set(wheel.namelist())
    bundled = {f"human/human-{pose}.safetensors" for pose in "TAI"} | {"rigs/dog.safetensors"}
    for model in ("hand", "head", "human", "quadruped"):
        bundled |= {f"models/{model}/{name}" for name in ("card.json", "weights.safetensors", "template.safetensors")}
    assert {f"meshmatch/_templates/{name}" for name in bundled} <= held
    assert len([name for name in held if name.startswith("meshmatch/_templates/samples/")]) >= 2


def test_the_wheel_holds_every_file_of_the_templates_folder_as_it_is(wheel: zipfile.ZipFile) -> None:
    folder = ROOT / "templates"
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert files
    for path in files:
        assert wheel.read(f"meshmatch/_templates/{path.relative_to(folder).as_posix()}") == path.read_bytes()


def test_the_wheel_holds_every_module_but_experiments_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    code = {name for name in wheel.namelist() if name.endswith(".py")}
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "meshmatch").rglob("*.py")}
    experiments = {name for name in modules if name.startswith("meshmatch/experiments/")}
    assert experiments
    assert code == modules - experiments
    assert {"meshmatch/_blender/convert.py", "meshmatch/_blender/addon/__init__.py"} < code
    assert not [name for name in wheel.namelist() if "experiments" in name]
    tops = {name.split("/")[0] for name in wheel.namelist()}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"meshmatch"}


def test_the_wheel_holds_the_viewer_with_the_licence_of_three(wheel: zipfile.ZipFile) -> None:
    folder = ROOT / "meshmatch" / "render" / "viewer"
    files = [path for path in folder.iterdir() if path.suffix != ".py" and path.is_file()]
    assert {".html", ".css", ".js", ".md", ".LICENSE"} == {path.suffix for path in files}
    for path in files:
        assert wheel.read(path.relative_to(ROOT).as_posix()) == path.read_bytes()
    notice = (folder / "three.LICENSE").read_text(encoding="utf-8")
    assert notice.startswith("The MIT License")
    assert notice in (folder / "three.min.js").read_text(encoding="utf-8")
    assert [
        name for name in wheel.namelist() if name.endswith(".dist-info/licenses/meshmatch/render/viewer/three.LICENSE")
    ]


def test_the_wheel_says_what_it_is(wheel: zipfile.ZipFile) -> None:
    said = metadata(wheel)
    assert said["License-Expression"] == "Apache-2.0"
    assert said["Author"] == "The meshmatch maintainers"
    urls = {line.split(", ")[0] for line in said.get_all("Project-URL", [])}
    assert urls == {"Homepage", "Documentation", "Changelog", "Issues"}
    assert "meshmatch/py.typed" in wheel.namelist()
    assert said["Requires-Python"] == ">=3.11"
    assert said["Version"] == importlib.import_module("meshmatch").__version__
    (points,) = (name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    assert b"meshmatch = meshmatch.cli:main" in wheel.read(points)
    (licence,) = (name for name in wheel.namelist() if name.endswith("licenses/LICENSE"))
    assert b"Apache License" in wheel.read(licence)


def test_pymeshlab_comes_only_when_asked_for(wheel: zipfile.ZipFile) -> None:
    required = [line for line in metadata(wheel).get_all("Requires-Dist", []) if "pymeshlab" in line]
    assert len(required) == 1
    assert required[0].endswith("extra == 'meshlab'")


def test_no_module_of_the_wheel_imports_experiments() -> None:
    for path in (ROOT / "meshmatch").rglob("*.py"):
        if "experiments" not in path.parts:
            assert "meshmatch.experiments" not in path.read_text(encoding="utf-8"), path


def test_a_checkout_finds_its_templates() -> None:
    assert location.bundled_folder() == ROOT / "templates"


def test_an_installed_package_finds_its_own_before_any_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = fake_package(tmp_path, monkeypatch)
    (tmp_path / "pyproject.toml").touch()
    (tmp_path / "templates").mkdir()
    assert location.bundled_folder() == tmp_path / "templates"
    (package / "_templates").mkdir()
    assert location.bundled_folder() == package / "_templates"


def test_a_strangers_templates_are_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_package(tmp_path, monkeypatch)
    (tmp_path / "templates").mkdir()  # beside site-packages/meshmatch this would be somebody else's
    with pytest.raises(TemplateError, match="neither in") as caught:
        location.bundled_folder()
    assert "install meshmatch again" in caught.value.hint


def fake_package(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package folder in which `location` believes to stand."""
    package = folder / "meshmatch"
    (package / "templates").mkdir(parents=True)
    monkeypatch.setattr(location, "__file__", str(package / "templates" / "location.py"))
    return package
