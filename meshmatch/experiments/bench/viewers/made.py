"""Make one output of each command and format, from the samples and the characters of the benchmark."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from meshmatch import cli
from meshmatch.errors import OutputError
from meshmatch.shapes.dressed_files import save_textured
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats import TexturedMesh
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_edit import Editor
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance, load_coordinates
from meshmatch.templates.location import bundled_folder

THROUGH_BLENDER = (".fbx", ".usdz", ".dae", ".blend")


@dataclass(frozen=True)
class Made:
    """A file written by a command, its verb, and the target file that the output is a modified copy of, if any."""

    path: Path
    verb: str
    target: Path | None = None


def made(folder: Path, data: Path, blender: bool, track: Callable[[Sequence[str]], Sequence[str]]) -> list[Made]:
    """Run the commands of `commands` whose outputs do not exist; formats that need Blender only with ``blender``."""
    inputs = _write_inputs(folder / "inputs", data)
    lines = [line.format(**inputs) for line in commands().splitlines() if line]
    found: list[Made] = []
    for line in track(lines):
        words = shlex.split(line)
        output = folder / words[words.index("-o") + 1]
        if output.suffix in THROUGH_BLENDER and not blender:
            continue
        words[words.index("-o") + 1] = str(output)
        words = [str(folder / word[1:]) if word.startswith("@") else word for word in words]
        if not output.exists() and (status := cli.main([*words, "--quiet"])):
            raise OutputError(f"meshmatch {shlex.join(words)} ended with status {status}")
        whose = words[1:2] if words[0] == "wrap" else words[2:4]
        back = next((Path(word) for word in whose if Path(word).suffix in (".glb", ".vrm")), None)
        if output.is_dir() and (files := sorted(output.glob("*.glb"))):  # one file is enough
            output = Path(shutil.copy(files[0], folder / f"{output.name}.glb"))
        if output.suffix not in (".npz", ""):
            found.append(Made(output, words[0], back))
    return found


def commands() -> str:
    """Return the commands, one per line; "@" marks the outputs of previous lines."""
    return """
match {dancer} {climber} -o body.npz
match {fox} {other_fox} -o fox.npz
transfer-texture {dancer} {climber} -o texture.glb --map @body.npz --size 512
transfer-texture {dancer} {climber} -o texture.obj --map @body.npz --size 512
transfer-texture {dancer} {man} -o texture-character.glb --size 512
transfer-color {painted} {climber} -o color.glb --map @body.npz
transfer-color {painted} {climber} -o color.obj --map @body.npz
transfer-color {painted} {climber} -o color.ply --map @body.npz
transfer-rig {man} {climber} -o rig.glb
transfer-rig {man} {climber} -o rig-source-pose.glb --pose source
transfer-rig {man} {dancer} -o rig-textured.glb
transfer-rig {man} {vrm} -o rig-vrm.glb
transfer-rig {fox} {other_fox} -o rig-clips.glb --map @fox.npz
transfer-rig {fox} {other_fox} -o rig-clips.fbx --map @fox.npz
transfer-rig {fox} {other_fox} -o rig-clips.usdz --map @fox.npz
transfer-rig {fox} {other_fox} -o rig-clips.dae --map @fox.npz
transfer-rig {fox} {other_fox} -o rig-clips.blend --map @fox.npz
transfer-texture {dancer} @rig.glb -o rig-dressed.glb --map @body.npz --size 512
transfer-shapes {dancer} {climber} -o shapes.glb --shapes {shapes} --map @body.npz
transfer-shapes {dancer} {climber} -o shapes.fbx --shapes {shapes} --map @body.npz
transfer-shapes {dancer} {climber} -o shapes.usdz --shapes {shapes} --map @body.npz
transfer-shapes {dancer} {climber} -o shapes.blend --shapes {shapes} --map @body.npz
transfer-shapes {dancer} @rig-dressed.glb -o shapes-rig.glb --shapes {shapes} --map @body.npz
transfer-garment {jacket} {dancer} {climber} -o garment.obj --map @body.npz
transfer-garment {jacket} {dancer} {climber} -o garment.glb --map @body.npz
transfer-garment {jacket} {dancer} @rig-dressed.glb -o garment-joined.glb --map @body.npz --join
wrap {dancer} {climber} -o wrap.glb
wrap {dressed} {climber} -o wrap.obj
wrap {man} {climber} -o wrap-rig.glb
register {climber} -o register.glb
register {climber} -o register.obj
register {dancer} --onto {climber} -o register-onto.glb
interpolate {dancer} {climber} -o interpolate --frames 2 --format glb
fit {dancer} {climber} -o fits
export @fits -o export --format glb
"""


def _write_inputs(folder: Path, data: Path) -> dict[str, str]:
    """Write missing input files; return their paths by the names that commands use."""
    samples, rigs = bundled_folder() / "samples", data / "rigs"
    found = {
        "dancer": samples / "dancer-textured.glb", "climber": samples / "climber.ply", "other_fox": samples / "fox.ply",
        "fox": rigs / "animals" / "Fox.glb", "man": rigs / "men" / "Casual.glb", "vrm": folder / "casual.vrm",
        "shapes": folder / "shapes", "jacket": folder / "jacket.obj", "dressed": folder / "dressed.obj",
        "painted": folder / "painted.glb",
    }  # fmt: skip
    found["shapes"].mkdir(parents=True, exist_ok=True)
    body = load_shape(found["dancer"])
    low, high = body.bounds
    x, y = ((body.verts[:, k] - low[k]) / (high[k] - low[k]) for k in (0, 1))
    chest = np.exp(-(((y - 0.7) / 0.1) ** 2) - ((x - 0.5) / 0.15) ** 2)[:, None]
    tall = float(high[1] - low[1])
    lean = np.clip(2 * (y - 0.5), 0, None)[:, None] * [0.15 * tall, 0.0, 0.0]
    for name, moves in (("breathe", 0.02 * tall * chest * body.vertex_normals), ("lean", lean)):
        save_shape(found["shapes"] / f"{name}.obj", Shape(body.verts + moves, body.faces))
    stripes = np.stack([(10 * y).astype(int) % 2, y, 1 - y, np.ones(body.V)], axis=1)
    save_shape(found["painted"], Shape(body.verts, body.faces, colors=stripes))
    bare = load_shape(samples / "dancer.ply")  # without the seams of the texture
    x, y = ((bare.verts[:, k] - low[k]) / (high[k] - low[k]) for k in (0, 1))
    upper = ((y > 0.5) & (y < 0.8) & (np.abs(x - 0.5) < 0.2))[bare.faces].all(axis=1)
    used, faces = np.unique(bare.faces[upper], return_inverse=True)
    shell = Shape(bare.verts[used] + 0.01 * tall * bare.vertex_normals[used], faces.reshape(-1, 3))
    save_shape(found["jacket"], shell)
    text = found["jacket"].read_text(encoding="utf-8")
    found["jacket"].write_text(f"mtllib jacket.mtl\nusemtl wool\n{text}", encoding="utf-8")
    (folder / "jacket.mtl").write_text("newmtl wool\nKd 0.5 0 0\n", encoding="utf-8")
    if not found["dressed"].exists():
        uv, look = load_coordinates(found["dancer"], body), load_appearance(found["dancer"], body)
        image = look.materials[0].image
        assert uv is not None and image is not None
        save_textured(found["dressed"], TexturedMesh(body.verts, body.faces, uv), image)
    found["vrm"].write_bytes(_as_vrm(found["man"]))
    return {key: shlex.quote(str(path)) for key, path in found.items()}


def _as_vrm(path: Path) -> bytes:
    """Add to a character the extension of VRM 1.0 that names the bones of a humanoid."""
    document = Document(path, path.read_bytes())
    editor = Editor(document)
    names = [node.get("name") for node in document.nodes]
    bones = {"hips": "Hips", "head": "Head"}
    human = {bone: {"node": names.index(name)} for bone, name in bones.items() if name in names}
    meta = {"name": path.stem, "authors": ["nobody"], "licenseUrl": "https://vrm.dev/licenses/1.0/"}
    extension = {"specVersion": "1.0", "meta": meta, "humanoid": {"humanBones": human}}
    editor.json.setdefault("extensionsUsed", []).append("VRMC_vrm")
    editor.json.setdefault("extensions", {})["VRMC_vrm"] = extension
    return editor.to_bytes()
