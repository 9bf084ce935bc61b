"""The paper's figures 4, 5 and 7, drawn, with the numbers behind them.

- 4: area distortion of the three representations of a field. Above, an arm pulled by the same handles; below, one body
  that nobody learned from, fitted by runs that differ in the field alone.
- 5: the same body fitted by runs that differ in their regularisers.
- 7: what the rules for nodes look at, a node that they refuse, and the three stages of choosing.

The runs are those of the ablations (`meshmatch.experiments.ablations`) with the same choices: they are trained where the
output folder lacks them, so that a stopped command goes on, and the ablations' own folder will do.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
from PIL import Image
from typer import Option

from meshmatch.api.inputs import as_model
from meshmatch.experiments import figure_fields, figure_nodes, runner
from meshmatch.experiments.ablation_errors import METHODS, Measure
from meshmatch.experiments.ablation_setting import Setting
from meshmatch.experiments.ablation_views import BASE, Run
from meshmatch.experiments.ablations import Kept
from meshmatch.experiments.figure_fields import FIGURE4, FIGURE5, FIT_COLUMNS, LOSSES, PULL_COLUMNS, SCALE
from meshmatch.fields.shape_functions import FIELDS
from meshmatch.models.trained import TrainedModel
from meshmatch.outputs import make_folder, replace_on_success
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look, render_shapes
from meshmatch.templates.template import read_template

FIGURES = ("4", "5", "7")
_FRONT = {"turn": 0.0, "tilt": 4.0}
_BODY = 5  # seed of the body that is fitted


def stacked(rows: Sequence[tuple[Sequence[Panel], Look]], path: Path) -> None:
    """Rows of panels above each other in one picture, as wide as the widest."""
    with tempfile.TemporaryDirectory() as folder:
        images = []
        for number, (panels, look) in enumerate(rows):
            part = Path(folder) / f"{number}.png"
            render_shapes(panels, part, look)
            images.append(Image.open(part).convert("RGB"))
    width = max(image.width for image in images)
    whole = Image.new("RGB", (width, sum(image.height for image in images)), (255, 255, 255))
    top = 0
    for image in images:
        whole.paste(image, ((width - image.width) // 2, top))
        top += image.height
    with replace_on_success(path) as temporary:
        whole.save(temporary, format="PNG", compress_level=9)


def models_of(kept: Kept, runs: Sequence[Run]) -> dict[Run, TrainedModel]:
    """Trained models, trained where they lack."""
    for run in runs:
        kept.train(run)
    return {run: as_model(kept.folder / run.name / "model") for run in runs}


def figure_4(kept: Kept, body: Any, method: str, path: Path) -> dict[str, list[dict[str, Any]]]:
    """Both rows of figure 4."""
    template = read_template("human-T")
    above = figure_fields.pull(template, "smooth", kept.measure.seed)
    below = figure_fields.fits(models_of(kept, FIGURE4), FIELDS, body, method, kept.measure)
    stacked([(above.panels, Look(**_FRONT)), (below.panels, Look(**_FRONT, legend=SCALE))], path)
    return {"pull": above.rows, "fits": below.rows}


def figure_5(kept: Kept, body: Any, method: str, path: Path) -> dict[str, list[dict[str, Any]]]:
    """The row of figure 5."""
    drawn = figure_fields.fits(models_of(kept, FIGURE5), LOSSES, body, method, kept.measure)
    render_shapes(drawn.panels, path, Look(**_FRONT, legend=SCALE))
    return {"losses": drawn.rows}


def figure_7(nodes: int, radius: float | None, path: Path) -> dict[str, list[dict[str, Any]]]:
    """Both templates' segmentations, and the stages on one of them."""
    templates = [read_template(name) for name in ("human-T", "human-A")]
    configs = [figure_nodes.config_of(template, nodes, radius) for template in templates]
    rows, bad = [], []
    for template, config in zip(templates, configs, strict=True):
        panels, numbers = figure_nodes.segmentations(template, config)
        rows.append((panels, Look(**_FRONT)))
        bad.append(numbers)
    panels, steps = figure_nodes.stages(templates[1], configs[1])
    stacked([*rows, (panels, Look(**_FRONT))], path)
    shares = [
        figure_nodes.refusals(template, figure_nodes.config_of(template, nodes, each))
        for template in templates
        for each in dict.fromkeys((configs[0].radius, 0.29))
    ]
    return {"refused": shares, "bad": bad, "stages": [steps]}


@runner.command
def main(
    output: Annotated[Path, Option(help="folder of the trained runs")] = Path("ablations"),
    figures: Annotated[str, Option(help=f"of {', '.join(FIGURES)}")] = ",".join(FIGURES),
    pictures: Annotated[Path, Option(help="folder of paper-figure-N.png")] = Path("docs/images"),
    minutes: Annotated[float, Option(min=0.01, help="of training a run")] = 1.0,
    method: Annotated[str, Option(help=f"refinement of the fits, of {', '.join(METHODS)}")] = "code",
    code_steps: Annotated[int, Option(min=1, help="of the search over codes")] = 60,
    nodes: Annotated[int, Option(min=4, help="of figure 7")] = 300,
    radius: Annotated[float | None, Option(help="of figure 7's nodes, sqrt(area); by default the template's")] = None,
    identities: Annotated[int, Option(min=1, help="of generated bodies")] = 1024,
    threads: runner.Threads = 1,
) -> runner.Report:
    wanted = runner.names_of(figures, FIGURES, "figure")
    make_folder(pictures)
    setting = Setting(identities=identities, threads=threads)
    method = runner.names_of(method, METHODS, "method")[0]
    kept = Kept(output, setting, Measure(code_steps=code_steps), minutes, "human", [], None, False)
    body = None
    if {"4", "5"} & set(wanted):
        body = setting.sources(BASE.pose)[1](1, torch.Generator().manual_seed(_BODY))[0].double().numpy()
    found: dict[str, list[dict[str, Any]]] = {}
    notes = []
    for name in wanted:
        path = pictures / f"paper-figure-{name}.png"
        if name == "7":
            found |= figure_7(nodes, radius, path)
        else:
            found |= (figure_4 if name == "4" else figure_5)(kept, body, method, path)
        notes.append(f"wrote {path}")
    titles = {
        "pull": ("Figure 4, an arm pulled by the same handles: change of triangles (log2 of area)", PULL_COLUMNS),
        "fits": ("Figure 4, one body fitted with each field", FIT_COLUMNS),
        "losses": ("Figure 5, one body fitted after each loss", FIT_COLUMNS),
        "refused": ("Figure 7, candidates that the rules refuse", figure_nodes.COLUMNS),
    }
    drawn = [runner.table(words, found[key], columns) for key, (words, columns) in titles.items() if key in found]
    notes += [str(row) for key in ("bad", "stages") for row in found.get(key, ())]
    return runner.Report(found, drawn, notes)


if __name__ == "__main__":
    sys.exit(main())
