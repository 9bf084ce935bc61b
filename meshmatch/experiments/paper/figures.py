"""The paper's figures 4 to 7, drawn, with the numbers behind them.

- 4: area distortion of the three representations of a field. Above, an arm pulled by the same handles; below, one body
  that nobody learned from, fitted with each.
- 5: the same body fitted after different regularisers.
- 6: bodies as a trained model's network fits them, and after both refinements.
- 7: what the rules for nodes look at, a node that they refuse, and the three stages of choosing; drawn with the templates'
  own radius (0.13), and counted with the paper's too: 0.2 of each template's diameter, as in table 7 of the ablations.

By default fields are fitted to the body themselves (`meshmatch.experiments.figure_direct`), without a network. With
--output, the fits are by runs of the ablations (`meshmatch.experiments.ablations`) with the same choices: they are trained
where the folder lacks them, so that a stopped command goes on, and the ablations' own folder will do.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from PIL import Image
from typer import Option

from meshmatch.api.inputs import as_model
from meshmatch.arrays import Floats
from meshmatch.experiments import runner
from meshmatch.experiments.makers.human_bodies import diameter, unseen_bodies
from meshmatch.experiments.paper import figure_nodes
from meshmatch.experiments.paper.ablation_errors import METHODS, Measure
from meshmatch.experiments.paper.ablation_setting import Setting
from meshmatch.experiments.paper.ablation_views import BASE, Run
from meshmatch.experiments.paper.ablations import Kept
from meshmatch.experiments.paper.figure_direct import CONSTRAINTS, Direct, direct_fits
from meshmatch.experiments.paper.figure_fields import (
    FIGURE4,
    FIGURE5,
    FIT_COLUMNS,
    LOSSES,
    OFF,
    PULL_COLUMNS,
    REFINED_COLUMNS,
    SCALE,
    Drawn,
    fits,
    pull,
    refinements,
)
from meshmatch.fields.shape_functions import FIELDS, FieldName
from meshmatch.models.trained import TrainedModel
from meshmatch.outputs import make_folder, replace_on_success
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look, render_shapes
from meshmatch.templates.template import read_template

FIGURES = ("4", "5", "6", "7")
_FRONT = Look(turn=0.0, tilt=4.0)
_WIDEST = 1400  # pixels
_REFINED = 2  # bodies of figure 6


def stacked(rows: Sequence[tuple[Sequence[Panel], Look]], path: Path) -> None:
    """Rows of panels above each other in one picture, as wide as the widest."""
    with tempfile.TemporaryDirectory() as folder:
        images = []
        for number, (panels, look) in enumerate(rows):
            part = Path(folder) / f"{number}.png"
            render_shapes(panels, part, look)
            with Image.open(part) as drawn:
                images.append(drawn.convert("RGB"))
    width = max(image.width for image in images)
    whole = Image.new("RGB", (width, sum(image.height for image in images)), (255, 255, 255))
    top = 0
    for image in images:
        whole.paste(image, ((width - image.width) // 2, top))
        top += image.height
    if width > _WIDEST:
        whole = whole.resize((_WIDEST, round(whole.height * _WIDEST / width)), Image.Resampling.LANCZOS)
    with replace_on_success(path) as temporary:
        whole.save(temporary, format="PNG", compress_level=9)


def models_of(kept: Kept, runs: Sequence[Run]) -> dict[Run, TrainedModel]:
    """Trained models, trained where they lack."""
    for run in runs:
        kept.train(run)
    return {run: as_model(kept.folder / run.name / "model") for run in runs}


def drawn_fits(figure: str, body: Floats, kept: Kept | None, method: str, how: Direct) -> Drawn:
    """The fits of figure 4 or 5: by trained runs, or without a network where there is no folder for them."""
    if kept is None:
        cases: list[tuple[FieldName, str, str]]
        cases = [(field, "vol+arap", field) for field in FIELDS] if figure == "4" else []
        cases = cases or [("mls", constraint, constraint) for constraint in CONSTRAINTS]
        return direct_fits(cases, read_template("human-T"), body, how)
    runs, names = (FIGURE4, list(FIELDS)) if figure == "4" else (FIGURE5, list(LOSSES))
    return fits(models_of(kept, runs), names, body, method, kept.measure)


def figure_7(nodes: int, radius: float | None, path: Path) -> dict[str, list[dict[str, Any]]]:
    """Both templates' segmentations, and the stages on one of them; what the rules refuse by the radius that is drawn, and
    by the paper's of each template."""
    templates = [read_template(name) for name in ("human-T", "human-A")]
    configs = [figure_nodes.config_of(template, nodes, radius) for template in templates]
    rows, bad = [], []
    for template, config in zip(templates, configs, strict=True):
        panels, numbers = figure_nodes.segmentations(template, config)
        rows.append((panels, _FRONT))
        bad.append(numbers)
    panels, steps = figure_nodes.stages(templates[1], configs[1])
    stacked([*rows, (panels, _FRONT)], path)
    shares = [
        figure_nodes.refusals(template, figure_nodes.config_of(template, nodes, each))
        for template, config in zip(templates, configs, strict=True)
        for each in dict.fromkeys((config.radius, BASE.radius * diameter(template.shape)))
    ]
    return {"refused": shares, "bad": bad, "stages": [steps]}


@runner.command
def main(
    figures: Annotated[str, Option(help=f"of {', '.join(FIGURES)}")] = ",".join(FIGURES),
    pictures: Annotated[Path, Option(help="folder of paper-figure-N.png, or -N-trained.png")] = Path("docs/images"),
    output: Annotated[Path | None, Option(help="folder of trained runs; by default none are used")] = None,
    train_steps: Annotated[int, Option(min=1, help="of training a run")] = 300,
    batch: Annotated[int | None, Option(min=1, help="shapes of a step of training a run")] = None,
    model: Annotated[str, Option(help="whose fits figure 6 shows")] = "human",
    method: Annotated[str, Option(help=f"refinement of a run's fits, of {', '.join(METHODS)}")] = "code",
    code_steps: Annotated[int, Option(min=1, help="of the search over codes")] = 60,
    supervised: Annotated[int, Option(min=4, help="template points with a known place, without a network")] = 300,
    steps: Annotated[int, Option(min=1, help="of Adam, without a network")] = 400,
    nodes: Annotated[int, Option(min=4, help="of figure 7")] = 300,
    radius: Annotated[float | None, Option(help="of figure 7's nodes, sqrt(area); by default the template's")] = None,
    seed: runner.Seed = 4,
    threads: runner.Threads = 1,
) -> runner.Report:
    wanted = runner.names_of(figures, FIGURES, "figure")
    method = runner.names_of(method, METHODS, "method")[0]
    make_folder(pictures)
    template, how = read_template("human-T"), Direct(supervised=supervised, steps=steps)
    kept = None
    if output is not None:
        measure = Measure(code_steps=code_steps)
        kept = Kept(output, Setting(threads=threads, batch=batch), measure, train_steps, None, "human", [], None, False)
    found: dict[str, list[dict[str, Any]]] = {}
    notes = []
    body = unseen_bodies(template, 1, seed=seed)[0] if {"4", "5"} & set(wanted) else np.empty((0, 3))
    for name in wanted:
        learned = kept is not None and name in ("4", "5")
        path = pictures / f"paper-figure-{name}{'-trained' if learned else ''}.png"
        if name == "7":
            found |= figure_7(nodes, radius, path)
        elif name == "6":
            bodies = list(unseen_bodies(template, _REFINED, seed=seed))
            refined = refinements(as_model(model), bodies, Measure(code_steps=code_steps, seed=seed))
            found["refined"] = [row for each in refined for row in each.rows]
            stacked(
                [(each.panels, replace(_FRONT, legend=OFF if each is refined[-1] else None)) for each in refined], path
            )
        else:
            below = drawn_fits(name, body, kept, method, how)
            found[f"fits {name}"] = below.rows
            rows = [(below.panels, replace(_FRONT, legend=SCALE))]
            if name == "4" and not learned:
                above = pull(template, "smooth", 0)
                found["pull"] = above.rows
                rows = [(above.panels, _FRONT), *rows]
            stacked(rows, path)
        notes.append(f"wrote {path}")
    titles = {
        "pull": ("Figure 4, an arm pulled by the same handles: change of triangles (log2 of area)", PULL_COLUMNS),
        "fits 4": ("Figure 4, one body fitted with each field", FIT_COLUMNS),
        "fits 5": ("Figure 5, one body fitted after each loss", FIT_COLUMNS),
        "refined": ("Figure 6, bodies fitted by the network, and refined", REFINED_COLUMNS),
        "refused": (
            "Figure 7, candidates that the rules refuse by the radius that is drawn, and by the paper's",
            figure_nodes.COLUMNS,
        ),
    }
    drawn = [runner.table(words, found[key], columns) for key, (words, columns) in titles.items() if key in found]
    notes += [str(row) for key in ("bad", "stages") for row in found.get(key, ())]
    return runner.Report(found, drawn, notes)


if __name__ == "__main__":
    sys.exit(main())
