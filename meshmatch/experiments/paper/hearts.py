"""Figure 14: transfer of the chambers of one heart to others, by three methods.

Without a model, two hearts are registered to each other; ZoomOut (pyfmaps) starts from descriptors; 3D-CODED is trained on
six of the hearts without correspondence, with the paper's losses and network, and searches codes by the Chamfer distance.
The source is one of the six, the targets are not. Each vertex of a target gets the chamber of its matched vertex on the
source; the result is shown with the ground truth, and evaluated. Errors are Euclidean, at vertices with a known
correspondence, x 100 / sqrt(area) of the source.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from PIL import Image
from typer import Option

from meshmatch.api.prepare import PrepareConfig, prepare
from meshmatch.arrays import Int, Ints
from meshmatch.experiments import runner
from meshmatch.experiments.bench.collections import HEART, TRUTH, heart_errors
from meshmatch.experiments.bench.methods import DirectMethod, Method, ZoomOut, coded
from meshmatch.experiments.bench.sets import load_folder
from meshmatch.outputs import make_folder, replace_on_success
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look, render_shapes
from meshmatch.shapes.colors import label_colors
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig
from meshmatch.training.recipes import paper_clouds
from meshmatch.training.train import train

_TRAINING_NAMES = tuple(f"heart{k:02d}" for k in range(1, 7))
SOURCE, TARGETS = _TRAINING_NAMES[0], ("heart07", "heart09", "heart10")
_COLUMNS = {"method": "method", "pairs": "pairs:d", "mean": "mean_x100:.2f", "worst pair": "worst_pair_x100:.2f"}
_COLUMNS |= {"right chamber": "right_chamber:.1%", "along the normals": "across_x100:.2f"}


def learn_coded(data: Path, work: Path, steps: int) -> Path:
    """Train 3D-CODED in a folder, or resume; return the model's folder."""
    if not (work / "prepared").is_dir():
        make_folder(work / "learned")
        for name in _TRAINING_NAMES:
            shutil.copy(data / HEART / f"{name}.ply", work / "learned")
        prepare(work / "learned", work / "prepared", PrepareConfig(nodes=NodeConfig("geodesic", 300)))
    recipe = paper_clouds().changed(field="pointwise", volume=0.0, arap=0.0, blend=0.0, steps=steps)
    return train(work / "coded", shapes=work / "prepared", recipe=recipe)


def row_of_hearts(method: str, shapes: dict[str, Shape], chambers: dict[str, Int[Ints, " V"]]) -> Image.Image:
    """Picture of the source and the targets side by side, with colored chambers."""
    panels = [
        Panel(shape, label_colors(chambers[name]), f"{name}, {method if name != SOURCE else 'given'}", sharp=True)
        for name, shape in shapes.items()
    ]
    with TemporaryDirectory() as folder:
        render_shapes(panels, Path(folder) / "row.png", Look(size=(1400, 420)))
        return Image.open(Path(folder) / "row.png").convert("RGB")


@runner.command
def main(
    data: runner.Data = runner.DATA,
    steps: Annotated[int, Option(min=1, help="training steps of 3D-CODED")] = 160,
    code_steps: Annotated[int, Option(min=1, help="steps of its search over codes")] = 200,
    picture: Annotated[Path | None, Option(help="write a PNG")] = None,
    work: runner.Work = None,
    seed: runner.Seed = 0,
) -> runner.Report:
    all_shapes, truth = load_folder(data / HEART, TRUTH)
    shapes = {name: all_shapes[name] for name in (SOURCE, *TARGETS)}
    known_chambers = {name: truth[name][:, 1] for name in shapes}
    rows: list[dict[str, Any]] = []
    picture_rows = [row_of_hearts("truth", shapes, known_chambers)]
    with TemporaryDirectory() as temporary:
        folder = work or Path(temporary)
        make_folder(folder)
        model = learn_coded(data, folder, steps)
        methods: dict[str, Method] = {"without a model": DirectMethod(seed), "ZoomOut": ZoomOut()}
        methods |= {"3D-CODED": coded(str(model), code_steps, seed)}
        for name, method in methods.items():
            runner.log(name)
            fits = {each: method.fit(shape) for each, shape in shapes.items()}
            maps = {
                (each, SOURCE): method.map(shapes[each], fits[each], shapes[SOURCE], fits[SOURCE]) for each in TARGETS
            }
            rows.append({"method": name, **heart_errors(shapes, truth, maps)})
            transferred = {each: known_chambers[SOURCE][maps[each, SOURCE].index] for each in TARGETS}
            picture_rows.append(row_of_hearts(name, shapes, known_chambers | transferred))
    if picture is not None:
        sheet = Image.new("RGB", (picture_rows[0].width, sum(row.height for row in picture_rows)), "white")
        for number, row in enumerate(picture_rows):
            sheet.paste(row, (0, number * row.height))
        with replace_on_success(picture) as path:
            sheet.save(path, format="PNG", compress_level=9)
    title = f"Chambers of a heart on three others (3D-CODED is short: {steps} steps of training)"
    return runner.Report({"rows": rows}, [runner.table(title, rows, _COLUMNS)])
