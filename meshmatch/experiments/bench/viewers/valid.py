"""Whether Khronos' validator finds no error and no warning in the glb files of a folder, such as those that tests wrote
(MESHMATCH_KEEP_GLB=FOLDER pytest).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from meshmatch.errors import InputError
from meshmatch.experiments import runner
from meshmatch.experiments.bench.viewers.opened import Found, check_tools, issues, validated
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_vrm import is_character

_OF_VRM = {"INVALID_EXTENSION_NAME_FORMAT", "MULTIPLE_EXTENSIONS"}
"""What characters are told of, for that is how VRM has it: an extension called VRM, and a toon material that is plain where
nobody knows it.
"""


def _codes(found: Found, file: Path) -> set[str]:
    codes = {code for _, code in issues(found, file)}
    return codes - _OF_VRM if codes & _OF_VRM and is_character(Document(file, file.read_bytes()).json) else codes


@runner.command
def main(
    folder: Annotated[Path, Argument(help="a folder of glb files")],
    modules: Annotated[Path, Option(help="npm's folder node_modules, with gltf-validator")] = Path("node_modules"),
) -> runner.Report:
    check_tools(["validator"], modules)
    files = runner.files_in(folder, "*.glb")
    found = validated(files, modules)
    rows = [{"file": file.name, "issues": ", ".join(sorted(_codes(found, file)))} for file in files]
    bad = [row for row in rows if row["issues"]]
    tables = [runner.table("With errors or warnings", bad, {"file": "file", "issues": "issues:<"})] if bad else []
    stopped = (
        InputError(f"{len(bad)} of {len(files)} files have errors or warnings", "they are named above") if bad else None
    )
    told = f"{len(files)} files, {len(files) - len(bad)} without errors and warnings"
    return runner.Report({"files": len(files), "bad": bad}, tables, [told], stopped)
