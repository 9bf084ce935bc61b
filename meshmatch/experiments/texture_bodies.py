"""One texture on bodies that may be shown: the picture of docs/textures.md.

The sample it was made for, the other sample, a generated body, and a generated body as cameras see it, with holes.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Annotated

from typer import Option

from meshmatch.api.texture import transfer_texture
from meshmatch.experiments import runner
from meshmatch.experiments.simulated_scans import simulated_scans
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look, render_shapes
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance
from meshmatch.templates.location import bundled_folder


def dressed(source: Path, target: Path | Shape, label: str, folder: Path) -> tuple[Panel, str]:
    """A body in the source's texture, and the verdict of the match."""
    found = transfer_texture(source, target)
    path = folder / f"{label}.glb"
    found.save(path)
    shape = load_shape(path)
    return Panel(shape, label=label, appearance=load_appearance(path, shape)), str(found.maps.forward.verdict)


@runner.command
def main(
    output: Annotated[Path, Option("-o", "--output", help="the picture")] = Path("texture-bodies.png"),
    seed: runner.Seed = 3,
) -> runner.Report:
    samples = bundled_folder() / "samples"
    source = samples / "dancer-textured.glb"
    (whole, _), (_, scan) = simulated_scans(2, seed)
    shape = load_shape(source)
    panels = [Panel(shape, label="the sample", appearance=load_appearance(source, shape))]
    targets: dict[str, Path | Shape] = {"the other sample": samples / "climber.ply"}
    targets |= {"a generated body": whole, "a scan of one, with holes": scan}
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for label, target in targets.items():
            panel, verdict = dressed(source, target, label, Path(folder))
            panels.append(panel)
            rows.append({"target": label, "verdict": verdict})
        render_shapes(panels, output, Look())
    return runner.Report({"targets": rows}, [runner.table("One texture", rows, {"on": "target", "verdict": "verdict"})])


if __name__ == "__main__":
    sys.exit(main())
