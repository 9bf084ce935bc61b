"""The extension for Blender: its file, and, where there is a Blender, what it does in it with a program for meshmatch."""

import json
import sys
import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pytest

import meshmatch
from meshmatch import blender
from meshmatch.cli import main
from meshmatch.shapes.formats import gltf_write
from tests.blender_at_hand import needs_blender, run_inside
from tests.transfer.rigs import tube

# Two tubes; each verb in turn, one that fails, one that is stopped, and one that has no program.
SCRIPT = """
import json, os, sys, time
from itertools import repeat
from types import MethodType, SimpleNamespace
import bpy
extension, program, tube = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.extensions.package_install_files(filepath=extension, repo="user_default", enable_on_install=True)
addon = sys.modules["bl_ext.user_default.meshmatch"]
preferences = bpy.context.preferences.addons[addon.__name__].preferences
preferences.command = program

def load():
    before = set(bpy.data.objects)
    bpy.ops.import_scene.gltf(filepath=tube)
    return next(each for each in bpy.data.objects if each not in before)

def run(verb):
    try:
        return sorted(bpy.ops.meshmatch.run("EXEC_DEFAULT", verb=verb))[0]
    except RuntimeError as error:  # a report of an error, as scripts see it
        return str(error)

told = {}
source, target, garment = load(), load(), load()
source.name, target.name = "source", "target"
target.location.x = 1
chosen = bpy.context.scene.meshmatch
told["nothing chosen"] = run("wrap")
chosen.source, chosen.target = source, target
told["no garment"] = run("transfer-garment")
chosen.garment = garment
for verb in addon.JOBS:
    before = set(bpy.data.objects)
    said = run(verb)
    made = [each for each in bpy.data.objects if each not in before]
    told[verb] = [said, [[each.name, each.type, round(each.location.x, 2)] for each in made]]
told["attributes"] = {
    name: [each.value for each in source.data.attributes[name].data][:3]
    for name in ("meshmatch_vertex", "meshmatch_confidence")
}
told["groups"] = [[group.name, round(group.weight(1), 3)] for group in target.vertex_groups]
os.environ["MESHMATCH_TEST"] = "fail"
told["fails"] = run("wrap")
os.environ["MESHMATCH_TEST"] = "sleep"
job = addon.Job("wrap", source, target, None, preferences.command)
while not job.process.progress()[1]:
    time.sleep(0.1)
told["progress"] = job.process.progress()
job.cancel()
told["stopped"] = [job.process.running.returncode != 0, os.path.exists(job.folder)]

# As a window runs it: no operator can be made without one, so that its methods get something like it.
timers = []
manager = SimpleNamespace(
    event_timer_add=lambda *_, **__: timers.append(1), event_timer_remove=lambda _: timers.pop(),
    modal_handler_add=lambda _: None,
)
context = SimpleNamespace(
    scene=bpy.context.scene, preferences=bpy.context.preferences, window_manager=manager, window=None, screen=None
)

def in_a_window(events):
    said = []
    operator = SimpleNamespace(verb="wrap", report=lambda kind, words: said.append(words))
    for name in ("begin", "show", "end"):
        setattr(operator, name, MethodType(getattr(addon.MeshmatchRun, name), operator))
    states = [sorted(addon.MeshmatchRun.invoke(operator, context, None))[0]]
    while states[-1] in ("RUNNING_MODAL", "PASS_THROUGH"):
        time.sleep(0.1)
        working = chosen.working
        states.append(sorted(addon.MeshmatchRun.modal(operator, context, SimpleNamespace(type=next(events))))[0])
    return [states[0], working, states[-1], said, chosen.working, len(timers), os.path.exists(operator.job.folder)]

told["esc"] = in_a_window(iter(["TIMER", "MOUSEMOVE", "ESC"]))
os.environ["MESHMATCH_TEST"] = "fail"
told["modal fails"] = in_a_window(repeat("TIMER"))
os.environ["MESHMATCH_TEST"] = ""
told["modal"] = in_a_window(repeat("TIMER"))
preferences.command = "/no/such/meshmatch"
told["no program"] = run("wrap")

class Layout:
    drawn = []
    def __getattr__(self, kind):
        def draw(*words, **options):
            self.drawn.append([kind, *(word for word in words if isinstance(word, str)), *map(str, options.values())])
            return self
        return draw

for chosen.working in (False, True):
    addon.MESHMATCH_PT_panel.draw(SimpleNamespace(layout=Layout()), bpy.context)
told["panel"] = Layout.drawn
bpy.ops.preferences.addon_disable(module=addon.__name__)
told["registered"] = hasattr(bpy.types.Scene, "meshmatch")
print("TOLD" + json.dumps(told))
sys.stdout.flush()
os._exit(0)
"""
# What stands in for meshmatch: its first file as the result, or arrays for the two jobs that want those.
PROGRAM = """
import os, shutil, sys, time
import numpy as np
verb, *files = sys.argv[1:-2]
assert sys.argv[-2] == "-o" and all(os.path.getsize(file) > 100 for file in files)
if os.environ.get("MESHMATCH_TEST") == "fail":
    sys.exit("error: the fit is poor\\nhint: try --only")
if os.environ.get("MESHMATCH_TEST") == "sleep":
    print("a.glb: refinement, 60 % (67 s)", flush=True)
    time.sleep(60)
if verb == "match":
    np.savez(sys.argv[-1], index=np.arange(COUNT)[::-1], confidence=np.full(COUNT, 0.5))
elif verb == "transfer-weights":
    joints, weights = np.tile([1, 0], (COUNT, 1)), np.tile([0.75, 0.25], (COUNT, 1))
    np.savez(sys.argv[-1], names=["hip", "knee", "none"], joints=joints, weights=weights)
else:
    shutil.copyfile(files[0], sys.argv[-1])
print(f"wrote {sys.argv[-1]}: {' '.join(files)}")
"""


@pytest.fixture
def extension(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    path = tmp_path / "meshmatch-blender.zip"
    assert main(["blender-addon", "-o", str(path)]) == 0
    assert "Install from Disk" in capsys.readouterr().err
    return path


def test_the_extension_has_a_manifest_of_this_version(extension: Path) -> None:
    with zipfile.ZipFile(extension) as archive:
        assert sorted(archive.namelist()) == ["__init__.py", "blender_manifest.toml"]
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
        compile(archive.read("__init__.py"), "__init__.py", "exec")
    assert manifest["version"] == meshmatch.__version__ and manifest["license"] == ["SPDX:Apache-2.0"]
    assert len(manifest["tagline"]) <= 64 and not manifest["tagline"].endswith(".")
    again = extension.with_name("again.zip")
    main(["blender-addon", "-q", "-o", str(again)])
    assert again.read_bytes() == extension.read_bytes()


def test_the_extension_calls_verbs_that_there_are(extension: Path) -> None:
    from typer.main import get_command

    from meshmatch.cli.app import app

    source = zipfile.ZipFile(extension).read("__init__.py").decode()
    jobs = source[source.index("JOBS = {") : source.index("\n}\n")]
    verbs = [line.split('"')[1] for line in jobs.splitlines()[1:]]
    assert len(verbs) == 7 and set(verbs) <= set(get_command(app).commands)  # type: ignore[attr-defined]


def test_another_suffix_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["blender-addon", "-o", str(tmp_path / "a.py")]) == 1
    assert "end the name in .zip" in capsys.readouterr().err and not list(tmp_path.iterdir())
    assert main(["blender-addon", "-o", "."]) == 1
    assert capsys.readouterr().err.startswith("error: .: an extension")


@needs_blender
def test_the_extension_works_in_blender(extension: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BLENDER_USER_RESOURCES", str(tmp_path / "user"))
    (tmp_path / "tube.glb").write_bytes(gltf_write.glb_of(tube()))
    program = tmp_path / "meshmatch"
    program.write_text(f"#!{sys.executable}{PROGRAM}".replace("COUNT", str(tube().V)))
    program.chmod(0o755)
    (tmp_path / "script.py").write_text(SCRIPT)
    said = run_inside(tmp_path / "script.py", extension, program, tmp_path / "tube.glb")
    told = json.loads(said.rpartition("TOLD")[2].splitlines()[0])
    assert "Choose two different objects" in told["nothing chosen"] and "Choose the garment" in told["no garment"]
    verbs = ("transfer-texture", "transfer-rig", "transfer-shapes", "transfer-garment", "wrap")
    for place, verb in enumerate(verbs, 1):
        status, made = told[verb]
        assert status == "FINISHED" and [kind for _, kind, _ in made] == ["MESH"], verb
        assert made[0][2] == pytest.approx(0.6 * place, abs=0.01)  # 1.2 times the width of 0.5, side by side
    for verb in ("transfer-weights", "match"):
        assert told[verb] == ["FINISHED", []]
    last = tube().V - 1
    assert told["attributes"] == {"meshmatch_vertex": [last, last - 1, last - 2], "meshmatch_confidence": [0.5] * 3}
    assert told["groups"] == [["hip", 0.25], ["knee", 0.75]]
    assert "error: the fit is poor hint: try --only" in told["fails"]
    assert told["progress"] == ["a.glb: refinement, 60 % (67 s)", 0.6]
    assert told["stopped"] == [True, False]
    assert "There is no program /no/such/meshmatch" in told["no program"]
    assert told["esc"] == ["RUNNING_MODAL", True, "CANCELLED", ["meshmatch was stopped"], False, 0, False]
    failed = ["error: the fit is poor hint: try --only"]
    assert told["modal fails"] == ["RUNNING_MODAL", True, "CANCELLED", failed, False, 0, False]
    done = ["wrote result.glb: source.glb target.glb"]
    assert told["modal"] == ["RUNNING_MODAL", True, "FINISHED", done, False, 0, False]
    assert told["registered"] is False
    buttons = [what[2] for what in told["panel"] if what[:2] == ["operator", "meshmatch.run"]]
    assert buttons == ["Texture", "Rig", "Weights", "Shape keys", "Garment", "Wrap", "Match"]
    assert [what[0] for what in told["panel"][-2:]] == ["progress", "operator"]


@needs_blender
def test_vertices_go_to_meshmatch_and_back_in_order(tmp_path: Path) -> None:
    """What a job that answers by vertex relies on."""
    script = """
import os, sys
import bpy
source, output = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=source)
bpy.ops.wm.ply_export(filepath=output, export_uv=False, export_normals=False, export_colors="NONE")
sys.stdout.flush()
os._exit(0)
"""
    (tmp_path / "script.py").write_text(script)
    (tmp_path / "tube.glb").write_bytes(gltf_write.glb_of(tube()))
    run_inside(tmp_path / "script.py", tmp_path / "tube.glb", tmp_path / "tube.ply")
    x, y, z = tube().verts.T
    np.testing.assert_allclose(meshmatch.load_shape(tmp_path / "tube.ply").verts, np.stack([x, -z, y], 1), atol=1e-5)


def test_the_folder_of_scripts_is_found() -> None:
    assert (blender.SCRIPTS / "convert.py").is_file()
