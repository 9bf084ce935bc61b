"""Check the glb files of a folder with Khronos' validator for errors and warnings.

Tests write their files to a folder with MESHMATCH_KEEP_GLB=FOLDER.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from meshmatch.errors import InputError
from meshmatch.experiments import runner
from meshmatch.experiments.bench.viewers.opened import Found, check_tools, issues, validate_gltf
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_vrm import is_character

_VRM_ISSUES = {"INVALID_EXTENSION_NAME_FORMAT", "MULTIPLE_EXTENSIONS"}
"""Issues that are inherent in VRM characters: the name of the extension VRM, and toon materials with a fallback for
viewers that do not know them.
"""


def _codes(found: Found, file: Path) -> set[str]:
    codes = {code for _, code in issues(found, file)}
    return (
        codes - _VRM_ISSUES if codes & _VRM_ISSUES and is_character(Document(file, file.read_bytes()).json) else codes
    )


@runner.command
def main(
    folder: Annotated[Path, Argument(help="a folder of glb files")],
    modules: Annotated[Path, Option(help="npm's folder node_modules, with gltf-validator")] = Path("node_modules"),
) -> runner.Report:
    check_tools(["validator"], modules)
    files = runner.files_in(folder, "*.glb")
    found = validate_gltf(files, modules)
    rows = [{"file": file.name, "issues": ", ".join(sorted(_codes(found, file)))} for file in files]
    bad = [row for row in rows if row["issues"]]
    tables = [runner.table("With errors or warnings", bad, {"file": "file", "issues": "issues:<"})] if bad else []
    stopped = (
        InputError(f"{len(bad)} of {len(files)} files have errors or warnings", "they are named above") if bad else None
    )
    note = f"{len(files)} files, {len(files) - len(bad)} without errors and warnings"
    return runner.Report({"files": len(files), "bad": bad}, tables, [note], stopped)
