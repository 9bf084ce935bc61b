"""What others open: every verb that writes shapes is there, tools are asked for in one line, and differences are found."""

import json
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.errors import OptionError
from meshmatch.experiments.bench.viewers import valid
from meshmatch.experiments.bench.viewers.__main__ import AS_WRITTEN
from meshmatch.experiments.bench.viewers.expected import Written, differences
from meshmatch.experiments.bench.viewers.made import THROUGH_BLENDER, commands
from meshmatch.experiments.bench.viewers.opened import HERE, check_tools, issues
from meshmatch.experiments.bench.viewers.sheet import covered, draw_sheet, overlap
from meshmatch.shapes.files import load_shape
from tests.shapes.morphs import write_morphs
from tests.transfer.rigs import write_tube

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "templates" / "samples" / "dancer-textured.glb"


def found_of(written: Written, **other: object) -> dict[str, object]:
    """What a viewer would find that opens a file as it was written."""
    bones = {"bones": sorted(written.joints)} if written.joints else {}
    return {
        **written.counts,
        **bones,
        "clips": ["clip"] * written.counts.get("clips", 0),
        "box": written.box.tolist(),
        **other,
    }


def test_every_verb_and_every_format_of_them_is_tried() -> None:
    lines = [shlex.split(line) for line in commands().splitlines() if line]
    verbs = {words[0] for words in lines}
    assert {"transfer-texture", "transfer-color", "transfer-rig", "transfer-shapes", "transfer-garment"} < verbs
    assert {"wrap", "register", "interpolate", "export"} < verbs
    outputs = {Path(words[words.index("-o") + 1]).suffix for words in lines}
    assert {".glb", ".obj", ".ply", *THROUGH_BLENDER} < outputs


def test_what_is_not_there_is_told_with_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OptionError, match="no gltf-validator") as error:
        check_tools(["validator"], tmp_path)
    assert "npm install" in error.value.hint and "--tools" in error.value.hint
    for package in ("gltf-validator", "three"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "package.json").write_text("{}")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.delenv("MESHMATCH_CHROMIUM", raising=False)
    with pytest.raises(OptionError, match="no node"):
        check_tools(["validator"], tmp_path)
    with pytest.raises(OptionError, match="no Chromium"):
        check_tools(["three"], tmp_path)


def test_a_file_as_it_was_written_differs_in_nothing() -> None:
    written = Written.of(SAMPLE)
    assert written.counts["images"] == written.counts["meshes"] == 1
    assert differences(written, found_of(written), "blender") == []


def test_differences_are_named(tmp_path: Path) -> None:
    write_tube(tmp_path / "tube.glb")
    written = Written.of(tmp_path / "tube.glb")
    assert (written.counts["bones"], written.counts["clips"]) == (4, 1)
    assert differences(written, found_of(written, bones=["hip", "knee", "x"]), "blender") == ["2 of 4 joints"]
    assert differences(written, found_of(written, clips=[]), "three") == ["0 of 1 clips"]
    lying = written.box[:, [0, 2, 1]]
    assert "lies" in differences(written, found_of(written, box=lying.tolist()), "three")[0]
    assert differences(written, found_of(written, box=(2 * written.box).tolist()), "three")[0] == "2 times as large"
    nowhere = [[None] * 3] * 2
    assert differences(written, found_of(written, box=nowhere), "three") == ["lies nowhere"]


def test_morph_targets_of_all_meshes_count(tmp_path: Path) -> None:
    write_morphs(tmp_path / "face.gltf")
    assert Written.of(tmp_path / "face.gltf").counts["morphs"] == 4


def test_issues_that_the_target_had_do_not_count() -> None:
    had = {"issues": [{"severity": 1, "code": "OLD"}, {"severity": 2, "code": "HINT"}]}
    now = {"issues": [{"severity": 1, "code": "OLD"}, {"severity": 1, "code": "OLD"}, {"severity": 0, "code": "NEW"}]}
    found = {"target.glb": had, "made.glb": now, "bad.glb": {"error": "no glTF"}}
    assert issues(found, Path("made.glb"), Path("target.glb")) == {(1, "OLD"): 1, (0, "NEW"): 1}
    assert sum(issues(found, Path("bad.glb"), None).values()) == 1


def test_pictures_are_compared_by_what_they_cover(tmp_path: Path) -> None:
    left, both = np.zeros((8, 8, 4), np.uint8), np.full((8, 8, 4), 255, np.uint8)
    left[:, :4] = 255
    Image.fromarray(left).save(tmp_path / "a.glb-blender.png")
    Image.fromarray(both).save(tmp_path / "a.glb-three.png")
    assert covered(tmp_path / "a.glb-blender.png") == 0.5
    assert overlap(tmp_path / "a.glb-blender.png", tmp_path / "a.glb-three.png") == 0.5
    draw_sheet(tmp_path / "sheet.png", ["a.glb"], tmp_path)
    with Image.open(tmp_path / "sheet.png") as sheet:
        assert sheet.size == (1600, 214)  # two files a row


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_the_script_of_the_validator_tells_of_each_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Through a stand-in, which warns of every file that is long enough."""
    module = tmp_path / "gltf-validator"
    module.mkdir()
    issue = "{severity: 1, code: 'ODD', message: 'odd', pointer: '/a'}"
    (module / "package.json").write_text('{"main": "index.js"}')
    (module / "index.js").write_text(
        "exports.version = () => '2'; exports.validateBytes = async (bytes) => {"
        f" if (bytes.length < 5) throw new Error('short'); return {{issues: {{messages: [{issue}]}}}}; }};"
    )
    (tmp_path / "a.glb").write_bytes(b"glTF....")
    (tmp_path / "b.glb").write_bytes(b"x")
    words = ["node", str(HERE / "validate.cjs"), str(tmp_path), str(tmp_path / "a.glb"), str(tmp_path / "b.glb")]
    lines = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
    first, second = map(json.loads, lines)
    assert first["issues"][0]["code"] == "ODD" and second["error"] == "Error: short"
    assert valid.main([str(tmp_path), "--modules", str(tmp_path)]) == 1
    told = capsys.readouterr()
    assert "2 files, 0 without errors and warnings" in told.out and "ODD" in told.out
    assert "2 of 2 files have errors or warnings" in told.err


def test_the_saved_run_found_every_glb_valid() -> None:
    saved = json.loads((ROOT / "docs" / "results" / "viewers.json").read_text(encoding="utf-8"))
    rows = saved["values"]["rows"]
    glb = [row for row in rows if row["file"].endswith(".glb")]
    assert len(glb) > 15 and all((row["errors"], row["warnings"]) == (0, 0) for row in glb)
    assert all(row["blender"] == row["three"] == AS_WRITTEN for row in glb)


def test_a_box_is_that_of_the_scene(tmp_path: Path) -> None:
    write_tube(tmp_path / "tube.glb")
    np.testing.assert_allclose(
        Written.of(tmp_path / "tube.glb").box, np.stack(load_shape(tmp_path / "tube.glb").bounds)
    )
