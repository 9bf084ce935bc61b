"""Check that other programs open the files that meshmatch writes, with the same content.

Every command that writes shapes is run for every format, on the samples and the characters of the benchmark. Khronos'
validator (npm's gltf-validator) checks each glTF file; Blender and three.js (npm's, in Chromium) open every file. The
meshes, triangles, bones, clips, morph targets and images that they find are compared with the contents of the file, and the
bounding box with that of the shape that meshmatch reads. Both render it from the same view: at rest, and in the middle of
its first clip with its first blendshape. The two pictures should cover the same pixels. Pictures are written to
OUTPUT/pictures, and all together to OUTPUT/sheet.png.

The tools must be installed: `npm install --prefix FOLDER gltf-validator three` and --modules FOLDER/node_modules; Blender as
for reading files (MESHMATCH_BLENDER); Chromium on the path or named by MESHMATCH_CHROMIUM. Issues that a target file had
before are not counted.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from meshmatch.errors import InputError
from meshmatch.experiments import runner
from meshmatch.experiments.bench.viewers.expected import Written, differences
from meshmatch.experiments.bench.viewers.made import Made, made
from meshmatch.experiments.bench.viewers.opened import (
    TOOLS,
    Found,
    check_tools,
    issues,
    open_in_blender,
    open_in_three,
    validate_gltf,
)
from meshmatch.experiments.bench.viewers.sheet import covered, draw_sheet, overlap
from meshmatch.outputs import make_folder

AS_WRITTEN, NO_READER = "as written", "has no reader"
_GLTF = (".glb", ".gltf", ".vrm")
_MIN_OVERLAP = 0.9  # minimum intersection over union of the covered pixels; silhouettes differ at edges
COLUMNS = {
    "file": "file", "by": "verb", "errors": "errors:d", "warnings": "warnings:d", "joints": "bones:d", "clips": "clips:d",
    "shapes": "morphs:d", "images": "images:d", "Blender": "blender", "three.js": "three",
}  # fmt: skip


SUMMARY = {
    "by": "verb", "files": "formats", "errors": "errors:d", "warnings": "warnings:d", "as written in Blender": "blender:>",
    "in three.js": "three:>", "otherwise": "otherwise:>",
}  # fmt: skip


def _rows(files: list[Made], valid: Found | None, opened: dict[str, Found], pictures: Path) -> list[dict[str, Any]]:
    """Compare each file with what the tools found and drew; return a row for each."""
    rows = []
    for each in files:
        written = Written.of(each.path)
        row: dict[str, Any] = {"file": each.path.name, "verb": each.verb} | written.counts
        if valid is not None and each.path.suffix in _GLTF:
            new = issues(valid, each.path, each.target)
            row["errors"] = sum(many for (severity, _), many in new.items() if severity == 0)
            row["warnings"] = sum(new.values()) - row["errors"]
            row["issues"] = sorted(code for _, code in new)
        for tool, found in opened.items():
            record = found[str(each.path)]
            wrong = [record["error"]] if "error" in record else differences(written, record, tool)
            drawn = pictures / f"{each.path.name}-{tool}.png"
            if "error" not in record and (not drawn.exists() or covered(drawn) < 0.02):
                wrong.append("nothing is seen")
            row[tool] = ", ".join(wrong) or AS_WRITTEN
        if len(opened) == 2 and all(row[tool] == AS_WRITTEN for tool in opened):
            for ending in ("-moved",) if written.begins("three") else ("", "-moved"):
                both = [pictures / f"{each.path.name}-{tool}{ending}.png" for tool in opened]
                if all(path.exists() for path in both) and (share := overlap(*both)) < _MIN_OVERLAP:
                    row["three"] = f"{'moved, ' * bool(ending)}covers {share:.0%} of the same pixels as in Blender"
        rows.append(row)
    return rows


def _summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Summarise the rows by verb."""
    found = []
    for verb in dict.fromkeys(row["verb"] for row in rows):
        some = [row for row in rows if row["verb"] == verb]
        formats = Counter(row["file"].rpartition(".")[2] for row in some)
        one: dict[str, Any] = {"verb": verb, "formats": ", ".join(f"{many} {name}" for name, many in formats.items())}
        valid = [row for row in some if "errors" in row]
        one |= {key: sum(row[key] for row in valid) for key in ("errors", "warnings") if valid}
        otherwise = []
        for tool, name in (("blender", "Blender"), ("three", "three.js")):
            opened = [row for row in some if row.get(tool, NO_READER) != NO_READER]
            if opened:
                one[tool] = f"{sum(row[tool] == AS_WRITTEN for row in opened)} of {len(opened)}"
            wrong = [row for row in opened if row[tool] != AS_WRITTEN]
            otherwise += [f"{row['file'].rpartition('.')[2]} in {name}: {row[tool]}" for row in wrong]
        found.append(one | {"otherwise": "; ".join(otherwise)})
    return found


@runner.command
def main(
    output: Annotated[Path, Argument(help="a folder for the files; existing ones are reused")],
    data: runner.Data = runner.DATA,
    modules: Annotated[Path, Option(help="npm's folder node_modules")] = Path("node_modules"),
    tools: Annotated[str, Option(help=f"of {', '.join(TOOLS)}")] = ",".join(TOOLS),
) -> runner.Report:
    chosen = runner.split_names(tools, TOOLS, "tool")
    check_tools(chosen, modules)
    pictures = output / "pictures"
    make_folder(pictures)
    files = made(
        output.absolute(), data.absolute(), "blender" in chosen, lambda lines: list(runner.track(lines, "files"))
    )
    valid, opened = None, {}
    if "validator" in chosen:
        gltf = {each for one in files for each in (one.path, one.target) if each is not None and each.suffix in _GLTF}
        valid = validate_gltf(sorted(gltf), modules)
    paths = [each.path for each in files]
    if "blender" in chosen:
        opened["blender"] = open_in_blender(paths, pictures.absolute())
    if "three" in chosen:
        opened["three"] = open_in_three([path for path in paths if path.suffix != ".blend"], pictures, modules)
        opened["three"] |= {str(path): {"error": NO_READER} for path in paths if path.suffix == ".blend"}
    rows = _rows(files, valid, opened, pictures)
    draw_sheet(output / "sheet.png", [each.path.name for each in files], pictures)
    tables = [runner.table("Opened elsewhere", rows, COLUMNS), runner.table("By verb", _summary(rows), SUMMARY)]
    bad = [row["file"] for row in rows if row.get("errors") or row.get("warnings")]
    stopped = InputError(f"with errors or warnings: {', '.join(bad)}", "--save has them") if bad else None
    return runner.Report({"rows": rows}, tables, [f"drew {output / 'sheet.png'}"], stopped)
