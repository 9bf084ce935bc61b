"""Files that Blender reads and writes: by a stand-in that copies glb, and, where there is a Blender, by that."""

import shutil
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import meshmatch
from meshmatch import blender
from meshmatch.errors import InputError, MeshmatchWarning, OptionError, OutputError
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.appearance import BakedMaterial
from meshmatch.shapes.deformed_files import add_appearance, save_moved, warn_about_lost
from meshmatch.shapes.dressed_files import Dressed, save_textured, warn_about_losses
from meshmatch.shapes.formats import gltf_write
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_edit import Editor
from meshmatch.shapes.formats.gltf_rig import read_rig
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import find_appearance, load_appearance
from meshmatch.transfer.weight_files import load_weights
from tests.blender_at_hand import needs_blender, run_inside, stand_in
from tests.shapes.painted import CORNERS, FACES, UV
from tests.transfer.rigs import tube, write_tube

HOSTILE = """
import bpy, os, sys
output, touched = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
mesh = bpy.data.meshes.new("mesh")
mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], [], [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)])
thing = bpy.data.objects.new("thing", mesh)
bpy.context.scene.collection.objects.link(thing)
text = bpy.data.texts.new("startup.py")
text.write(f"open({touched + '-text'!r}, 'w').close()")
text.use_module = True
driver = thing.driver_add("location", 0).driver
driver.type, driver.expression = "SCRIPTED", f"(open({touched + '-driver'!r}, 'w').close(), 0.0)[1]"
bpy.data.libraries.write(output, {bpy.context.scene, text}, fake_user=True)
sys.stdout.flush()
os._exit(0)
"""
SOLIDS = """
import bpy, os, sys
for name in ("cube", "ico_sphere"):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    getattr(bpy.ops.mesh, f"primitive_{name}_add")()
    bpy.ops.wm.save_as_mainfile(filepath=os.path.join(sys.argv[-1], f"{name}.blend"))
sys.stdout.flush()
os._exit(0)
"""
HIDDEN = """
import bpy, os, sys
def cube(name, collection):
    bpy.ops.mesh.primitive_cube_add()
    thing = bpy.context.object
    thing.name = name
    bpy.context.scene.collection.objects.unlink(thing)
    collection.objects.link(thing)
    return thing
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
made = {name: bpy.data.collections.new(name) for name in ("shown", "left out", "not rendered", "character")}
for name in ("shown", "left out", "not rendered"):
    scene.collection.children.link(made[name])
    cube(name, made[name])
cube("character", made["character"])
cube("veiled", made["shown"]).hide_set(True)
bpy.context.view_layer.layer_collection.children["left out"].exclude = True
made["not rendered"].hide_render = True
copy = bpy.data.objects.new("copy", None)
copy.instance_type, copy.instance_collection = "COLLECTION", made["character"]
scene.collection.objects.link(copy)
bpy.ops.wm.save_as_mainfile(filepath=os.path.join(sys.argv[-1], "hidden.blend"))
scene.collection.children.unlink(made["shown"])
bpy.ops.wm.save_as_mainfile(filepath=os.path.join(sys.argv[-1], "copy.blend"))
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
talking, smooth = cube("talking", scene.collection), cube("smooth", scene.collection)
talking.shape_key_add(name="Basis")
for thing in (talking, smooth):
    thing.modifiers.new("Subdivision", "SUBSURF")
bpy.ops.wm.save_as_mainfile(filepath=os.path.join(sys.argv[-1], "smooth.blend"))
sys.stdout.flush()
os._exit(0)
"""
TRUSTING = """
import bpy, os, sys
bpy.context.preferences.filepaths.use_scripts_auto_execute = True
bpy.ops.wm.open_mainfile(filepath=sys.argv[sys.argv.index("--") + 1], use_scripts=True)
os._exit(0)
"""


def test_a_file_goes_through_a_glb_both_ways(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch)
    for suffix in blender.WRITABLE:
        meshmatch.save_shape(tmp_path / f"tube{suffix}", tube())
        assert (tmp_path / f"tube{suffix}").read_bytes()[:4] == b"glTF"
        back = meshmatch.load_shape(tmp_path / f"tube{suffix}")
        np.testing.assert_allclose(back.verts, tube().verts, atol=1e-6)
        np.testing.assert_array_equal(back.faces, tube().faces)
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_skin_look_and_skeleton_come_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch)
    write_tube(tmp_path / "tube.glb")
    (tmp_path / "tube.glb").rename(tmp_path / "tube.FBX")
    path = tmp_path / "tube.FBX"
    shape = meshmatch.load_shape(path)
    assert load_weights(path, shape).names == ("root", "hip", "knee", "foot")
    assert [clip.name for clip in read_rig(path, read_bytes(path)).clips] == ["bend"]
    dancer = Path("templates/samples/dancer-textured.glb")
    (tmp_path / "dancer.usdz").write_bytes(dancer.read_bytes())
    look = load_appearance(tmp_path / "dancer.usdz", meshmatch.load_shape(tmp_path / "dancer.usdz"))
    assert look.materials[0].image is not None


def test_a_file_is_converted_once_until_it_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = tmp_path / "log"
    stand_in(tmp_path, monkeypatch, f"open({str(log)!r}, 'a').write('x'); shutil.copyfile(source, output)")
    path = tmp_path / "a.fbx"
    path.write_bytes(gltf_write.glb_of(tube()))
    for _ in range(3):
        meshmatch.load_shape(path)
    assert log.read_text() == "x"
    moved = meshmatch.Shape(tube().verts + 1.0, tube().faces)
    path.write_bytes(gltf_write.glb_of(moved) + b"    ")
    assert meshmatch.load_shape(path).verts.max() > tube().verts.max() + 0.5
    assert log.read_text() == "xx"


def test_without_blender_the_line_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(blender.ENVIRONMENT_VARIABLE, raising=False)
    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    path = tmp_path / "a.fbx"
    path.write_bytes(b"Kaydara FBX Binary  ")
    with pytest.raises(OptionError, match="needs Blender") as error:
        meshmatch.load_shape(path)
    assert "pip install bpy" in error.value.hint and blender.ENVIRONMENT_VARIABLE in error.value.hint
    with pytest.raises(OptionError, match="needs Blender"):
        meshmatch.save_shape(tmp_path / "b.blend", tube())
    monkeypatch.setenv(blender.ENVIRONMENT_VARIABLE, "/no/such/blender")
    with pytest.raises(OptionError, match="there is no program"):
        meshmatch.load_shape(path)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.fbx"]


def test_an_fbx_of_text_is_to_be_exported_as_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch, "sys.exit('Error: ASCII FBX files are not supported')")
    for head, hint in ((b"; FBX 7.4.0 project file", "binary .fbx, or as .glb"), (b"Kaydara", "is it damaged?")):
        (tmp_path / "a.fbx").write_bytes(head + b"\n" * len(hint))
        with pytest.raises(InputError, match="ASCII FBX") as error:
            meshmatch.load_shape(tmp_path / "a.fbx")
        assert hint in error.value.hint


@pytest.mark.parametrize(
    ("does", "words"),
    [
        ("print('Error: no DNA block'); sys.exit(1)", "no DNA block"),
        ("sys.exit(3)", "status 3"),
        ("time.sleep(60)", "took longer"),
        ("open(output, 'w').write('nothing')", "does not begin with"),
    ],
)
def test_trouble_in_blender_is_one_line(does: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch, does)
    monkeypatch.setattr(blender, "_TIMEOUT", 5 if "sleep" not in does else 1)
    (tmp_path / "a.fbx").write_bytes(b"x")
    began = time.monotonic()
    with pytest.raises(InputError, match=words):
        meshmatch.load_shape(tmp_path / "a.fbx")
    assert time.monotonic() - began < 30


@pytest.mark.parametrize(
    ("does", "words"),
    [("pass", "wrote nothing"), ("raise ModuleNotFoundError(\"No module named 'bpy'\")", "No module named 'bpy'")],
)
def test_a_program_that_is_not_blender_is_told(
    does: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in(tmp_path, monkeypatch, does)
    (tmp_path / "a.fbx").write_bytes(b"x")
    with pytest.raises(InputError, match=words) as caught:
        meshmatch.load_shape(tmp_path / "a.fbx")
    assert blender.ENVIRONMENT_VARIABLE in caught.value.hint
    with pytest.raises(OutputError, match=words) as failed:
        meshmatch.save_shape(tmp_path / "b.fbx", tube())
    assert blender.ENVIRONMENT_VARIABLE in failed.value.hint
    assert not (tmp_path / "b.fbx").exists()


def test_images_of_a_dae_replace_no_other_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = "os.path.join(os.path.dirname(output), 'a-skin.png')"
    does = f"import os; shutil.copyfile(source, output); open({image}, 'w').write('new'); os.mkdir(output + '-cache')"
    stand_in(tmp_path, monkeypatch, does)
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "a-skin.png").write_text("mine")
    (folder / "a.dae").write_text("before")
    with pytest.raises(OptionError, match=r"another .*a-skin\.png is there"):
        meshmatch.save_shape(folder / "a.dae", tube())
    assert {each.name: each.read_text() for each in folder.iterdir()} == {"a-skin.png": "mine", "a.dae": "before"}
    (folder / "a-skin.png").unlink()
    for _ in range(2):  # its own image may be there
        meshmatch.save_shape(folder / "a.dae", tube())
        assert sorted(each.name for each in folder.iterdir()) == ["a-skin.png", "a.dae"]
        assert (folder / "a-skin.png").read_text() == "new"
        assert (folder / "a.dae").read_bytes()[:4] == b"glTF"


def test_what_cannot_be_written_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch, "print('Error: no room'); sys.exit(1)")
    (tmp_path / "a.fbx").write_bytes(b"before")
    with pytest.raises(OutputError, match="no room"):
        meshmatch.save_shape(tmp_path / "a.fbx", tube())
    assert (tmp_path / "a.fbx").read_bytes() == b"before"
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.fbx", "blender"]
    with pytest.raises(OptionError, match="only read"):
        meshmatch.save_shape(tmp_path / "a.usda", tube())


def test_what_is_left_out_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch, "print('note: left out skin.png'); shutil.copyfile(source, output)")
    (tmp_path / "a.fbx").write_bytes(gltf_write.glb_of(tube()))
    with pytest.warns(MeshmatchWarning, match=r"a\.fbx: left out skin\.png"):
        meshmatch.load_shape(tmp_path / "a.fbx")


def test_polygons_that_become_triangles_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """When something is made of the file, not when it is read."""
    stand_in(tmp_path, monkeypatch, "print('with polygons'); shutil.copyfile(source, output)")
    path, out = tmp_path / "a.fbx", tmp_path / "out.fbx"
    path.write_bytes(gltf_write.glb_of(tube()))
    shape = meshmatch.load_shape(path)
    told = r"^out\.fbx does not have the polygons of a\.fbx$"
    with pytest.warns(MeshmatchWarning, match=told):
        save_moved(out, path, shape, np.tile(np.eye(3), (shape.V, 1, 1)))
    with pytest.warns(MeshmatchWarning, match=told):
        warn_about_losses(path, out)
    _, lost = add_appearance(gltf_write.glb_of(tube()), path, shape)
    with pytest.warns(MeshmatchWarning, match=told):
        warn_about_lost(out, path, lost)


@needs_blender
def test_blender_says_whether_there_are_polygons(tmp_path: Path) -> None:
    (tmp_path / "make.py").write_text(SOLIDS)
    run_inside(tmp_path / "make.py", tmp_path)
    for name in ("cube", "ico_sphere"):
        assert blender.has_polygons(tmp_path / f"{name}.blend") == (name == "cube")


@needs_blender
def test_a_blend_file_has_what_its_renders_show(tmp_path: Path) -> None:
    (tmp_path / "make.py").write_text(HIDDEN)
    run_inside(tmp_path / "make.py", tmp_path)
    with pytest.warns(MeshmatchWarning, match="only the view hides: veiled "):
        shape = meshmatch.load_shape(tmp_path / "hidden.blend")
    assert {name for name, _ in shape.meshes} == {"shown", "veiled", "character"}
    assert meshmatch.load_shape(tmp_path / "copy.blend").F == 12
    with pytest.warns(MeshmatchWarning, match="modifiers are left out of meshes with shape keys: talking$"):
        assert meshmatch.load_shape(tmp_path / "smooth.blend").F == 12 + 48


def test_works_of_an_artist_beside_shapes_of_a_folder_are_left_alone(tmp_path: Path) -> None:
    from meshmatch.collections.sources import find_sources
    from meshmatch.collections.stores import Store

    for name in ("a.fbx", "a.blend", "b.fbx"):
        (tmp_path / name).write_bytes(b"x")
    fits = Store.of(tmp_path / "fits")
    with pytest.raises(InputError, match="two shapes are called a"):
        find_sources(tmp_path, fits)
    (tmp_path / "a.blend").unlink()
    found, left_out = find_sources(tmp_path, fits)
    assert ([source.file for source in found], left_out) == (["a.fbx", "b.fbx"], [])
    for name in ("c.ply", "c.blend", "c.npy"):
        (tmp_path / name).write_bytes(b"x")
    with pytest.warns(MeshmatchWarning, match=r"Blender files next to other shapes are left out: a\.fbx, b\.fbx$"):
        found, left_out = find_sources(tmp_path, fits)
    assert [source.file for source in found] == ["c.ply"]
    assert [record.name for record in left_out] == ["a.fbx", "b.fbx"]


@needs_blender
@pytest.mark.parametrize("suffix", blender.WRITABLE)
def test_blender_keeps_place_skeleton_and_weights(suffix: str, tmp_path: Path) -> None:
    before = write_tube(tmp_path / "tube.glb", clips=suffix != ".dae")  # whose joints stand as a clip begins
    path = tmp_path / f"tube{suffix}"
    blender.from_glb(tmp_path / "tube.glb", path, path)
    shape, old = meshmatch.load_shape(path), meshmatch.load_shape(tmp_path / "tube.glb")
    assert len(shape.faces) == len(before.faces)
    np.testing.assert_allclose(shape.verts.min(0), old.verts.min(0), atol=3e-3)
    np.testing.assert_allclose(shape.verts.max(0), old.verts.max(0), atol=3e-3)
    names = load_weights(path, shape).names
    assert {"root", "hip", "knee", "foot"} <= set(names)
    rig, given = read_rig(path, read_bytes(path)), read_rig(tmp_path / "tube.glb", read_bytes(tmp_path / "tube.glb"))
    places = dict(zip(rig.names, rig.worlds()[:, :3, 3], strict=True))
    for joint in given.joints:
        np.testing.assert_allclose(places[given.names[joint]], given.worlds()[joint, :3, 3], atol=2e-3)


def test_what_blender_says_names_the_file_of_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch, "print('note: odd'); shutil.copyfile(source, output)")
    with pytest.warns(MeshmatchWarning, match=r"^mine\.fbx: odd"):
        meshmatch.save_shape(tmp_path / "mine.fbx", tube())


@needs_blender
@pytest.mark.parametrize("suffix", [".usdz", ".dae", ".fbx"])
def test_clips_that_a_format_does_not_hold_are_told(suffix: str, tmp_path: Path) -> None:
    write_tube(tmp_path / "tube.glb")
    document = Document(tmp_path / "tube.glb", (tmp_path / "tube.glb").read_bytes())
    editor = Editor(document)
    editor.json["animations"].append(editor.json["animations"][0] | {"name": "again"})
    (tmp_path / "tube.glb").write_bytes(editor.to_bytes())
    path = tmp_path / f"tube{suffix}"
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        blender.from_glb(tmp_path / "tube.glb", path, path)
    words = [str(each.message) for each in said]
    told = [f"tube{suffix}: a {suffix} file holds one clip: of 2 only bend"]
    assert words == ([] if suffix == ".fbx" else told)


@needs_blender
@pytest.mark.parametrize("suffix", blender.WRITABLE)
def test_blender_keeps_an_image(suffix: str, tmp_path: Path) -> None:
    sample = Path("templates/samples/dancer-textured.glb")
    path = tmp_path / f"dancer{suffix}"
    with replace_on_success(path) as glb:
        shutil.copyfile(sample, glb)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        look = find_appearance(path, meshmatch.load_shape(path))
    old = load_appearance(sample, meshmatch.load_shape(sample))
    assert look is not None and look.materials[0].image is not None and old.materials[0].image is not None
    assert look.materials[0].image.shape == old.materials[0].image.shape
    beside = {"dancer-dancer-textured.png"} if suffix == ".dae" else set()
    assert {each.name for each in tmp_path.iterdir()} == {path.name} | beside


@needs_blender
def test_blender_writes_a_textured_mesh_as_fbx(tmp_path: Path) -> None:
    from meshmatch.shapes.formats import TexturedMesh

    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    mesh = TexturedMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros((2, 3, 2)))
    save_textured(tmp_path / "a.fbx", mesh, np.full((4, 4, 4), 200, np.uint8))
    assert (tmp_path / "a.fbx").read_bytes().startswith(b"Kaydara FBX Binary")
    assert meshmatch.load_shape(tmp_path / "a.fbx").F == 2


@needs_blender
@pytest.mark.parametrize("suffix", blender.WRITABLE)
def test_blender_keeps_each_image_of_a_material(suffix: str, tmp_path: Path) -> None:
    """An fbx took the color for the normals and the emission; what a format does not hold is told."""
    colors = {"color": (200, 40, 40), "normal": (128, 128, 255), "surface": (255, 60, 180), "glow": (10, 220, 90)}
    images = {name: np.full((32, 32, 4), [*color, 255], np.uint8) for name, color in colors.items()}
    made = BakedMaterial(
        **images, name="made", double_sided=False, occluded=True, metal=1.0, roughness=1.0, light=(1.0, 1.0, 1.0)
    )
    Dressed(Shape(CORNERS, FACES, "square"), None, UV[FACES], False, made).save(tmp_path / "a.glb")
    path = tmp_path / f"a{suffix}"
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        with replace_on_success(path) as glb:
            shutil.copyfile(tmp_path / "a.glb", glb)
        look = load_appearance(path, meshmatch.load_shape(path))
    lost = {".fbx": "occlusion", ".usdz": "occlusion", ".dae": "normals, roughness, metal, emission, occlusion"}
    words = [str(each.message) for each in told if "holds no images" in str(each.message)]
    assert [word.partition("images of ")[2] for word in words] == [lost[suffix]] if suffix in lost else not words
    assert look.materials[0].image is not None and look.finish is not None
    found = {"color": look.materials[0].image} | {
        name: layer.materials[0].image for name, layer in look.finish.layers.items()
    }
    for name in ("color",) if suffix == ".dae" else ("color", "normal", "surface", "glow"):
        image = found[name]
        assert image is not None
        off = np.abs(image[..., :3].reshape(-1, 3).mean(axis=0) - colors[name])
        assert off[1 if name == "surface" else 0 :].max() < 4, name


@needs_blender
def test_clips_of_an_fbx_keep_their_names(tmp_path: Path) -> None:
    """Each time, Blender puts the name of the skeleton before them."""
    write_tube(tmp_path / "tube.glb")
    for before, after in (("tube.glb", "a.fbx"), ("a.fbx", "b.fbx")):
        with replace_on_success(tmp_path / after) as glb:
            glb.write_bytes(read_bytes(tmp_path / before))
    assert [clip.name for clip in read_rig(tmp_path / "b.fbx", read_bytes(tmp_path / "b.fbx")).clips] == ["bend"]


@needs_blender
def test_a_clip_of_one_object_moves_no_other_in_an_fbx(tmp_path: Path) -> None:
    """A step of something that stands beside a skeleton led all that the skeleton moves away."""
    write_tube(tmp_path / "tube.glb")
    editor = Editor(Document(tmp_path / "tube.glb", (tmp_path / "tube.glb").read_bytes()))
    steps = editor.add_node("steps", np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
    editor.json["scenes"][0]["nodes"].append(steps)
    times, places = np.array([0.0, 1.0], np.float32), np.array([[0, 90, 0], [0, 95, 0]], np.float32)
    sampler = {"input": editor.add_array(times, bounds=True), "output": editor.add_array(places)}
    channel = {"sampler": 0, "target": {"node": steps, "path": "translation"}}
    editor.json["animations"].append({"name": "walk", "samplers": [sampler], "channels": [channel]})
    (tmp_path / "both.glb").write_bytes(editor.to_bytes())
    path = tmp_path / "both.fbx"
    blender.from_glb(tmp_path / "both.glb", path, path)
    old, new = meshmatch.load_shape(tmp_path / "both.glb"), meshmatch.load_shape(path)
    np.testing.assert_allclose(new.verts.min(0), old.verts.min(0), atol=3e-3)
    np.testing.assert_allclose(new.verts.max(0), old.verts.max(0), atol=3e-3)
    document = Document(path, read_bytes(path))
    moved = {
        clip["name"]: {document.nodes[channel["target"]["node"]]["name"] for channel in clip["channels"]}
        for clip in document.json["animations"]
    }
    assert set(moved) == {"bend", "walk"} and moved["walk"] == {"steps"}
    assert {"hip", "knee", "foot"} <= moved["bend"] and "steps" not in moved["bend"]


@needs_blender
def test_scripts_and_drivers_of_a_blend_file_do_not_run(tmp_path: Path) -> None:
    for name, text in (("hostile.py", HOSTILE), ("trusting.py", TRUSTING)):
        (tmp_path / name).write_text(text)
    touched = tmp_path / "touched"
    run_inside(tmp_path / "hostile.py", tmp_path / "a.blend", touched)
    assert meshmatch.load_shape(tmp_path / "a.blend").F == 4
    assert not list(tmp_path.glob("touched*"))
    run_inside(tmp_path / "trusting.py", tmp_path / "a.blend")  # who trusts the file does run them
    assert (tmp_path / "touched-text").exists()


STAGE = """#usda 1.0
(
    defaultPrim = "a"
    upAxis = "Z"
    metersPerUnit = 0.01
)
def Mesh "a" {
    int[] faceVertexCounts = [3, 3]
    int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
    point3f[] points = [(0, 0, 0), (100, 0, 0), (100, 0, 200), (0, 0, 200)]
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 0), (1, 1), (0, 1)] (
        interpolation = "faceVarying"
    )
    rel material:binding = </m>
}
def Material "m" {
    token outputs:surface.connect = </m/s.outputs:surface>
    def Shader "s" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </m/t.outputs:rgb>
        token outputs:surface
    }
    def Shader "t" {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @IMAGE@
        float2 inputs:st.connect = </m/r.outputs:result>
        float3 outputs:rgb
    }
    def Shader "r" {
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }
}
"""


@needs_blender
@pytest.mark.parametrize("inside", [True, False])
def test_axes_and_unit_are_the_headers_and_images_those_of_the_folder(tmp_path: Path, inside: bool) -> None:
    (tmp_path / "asset").mkdir()
    path, image = tmp_path / "asset" / "a.usda", tmp_path / ("asset/skin.png" if inside else "skin.png")
    Image.new("RGB", (8, 8), (200, 30, 30)).save(image)
    path.write_text(STAGE.replace("IMAGE", str(image)))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        shape = meshmatch.load_shape(path)
    np.testing.assert_allclose(shape.verts.max(0) - shape.verts.min(0), [1, 2, 0], atol=1e-6)  # metres, y up
    look = find_appearance(path, shape)
    assert (look is not None and look.materials[0].image is not None) is inside
    assert [str(each.message) for each in told] == (
        [] if inside else ["a.usda: left out files that are missing or outside its folder: skin.png"]
    )


@needs_blender
@pytest.mark.parametrize("suffix", blender.WRITABLE)
def test_a_file_that_is_cut_short_is_one_line(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"tube{suffix}"
    meshmatch.save_shape(path, tube())
    path.write_bytes(path.read_bytes()[:800])
    with pytest.raises(InputError, match="cannot be read"):
        meshmatch.load_shape(path)
