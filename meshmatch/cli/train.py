"""``meshmatch train``."""

import os
from typing import TYPE_CHECKING

from meshmatch.cli import options
from meshmatch.cli import training_options as given
from meshmatch.cli.console import Console, print_json
from meshmatch.cli.output_paths import check_chart, check_writable
from meshmatch.outputs import make_folder

if TYPE_CHECKING:
    from pathlib import Path

    from meshmatch.training.loop import StepReport


def train(
    output: given.ModelFolder,
    template: given.BodyTemplate = "human-T",
    shapes: given.TrainingShapes = None,
    unsupervised: given.Unsupervised = False,
    preset: given.PresetOption = "default",
    field: given.FieldOption = "mls",
    start: given.Start = None,
    rate: given.Rate = None,
    blend: given.Blend = None,
    stiffness: given.Stiffness = 1.0,
    name: given.ModelName = None,
    category: given.Category = None,
    licence: given.Licence = "unstated",
    steps: given.Steps = None,
    minutes: given.Minutes = None,
    identities: given.Identities = 4096,
    poses: given.Poses = None,
    pose_share: given.PoseShare = 0.5,
    bf16: given.Bf16 = None,
    workers: given.Workers = None,
    threads: options.Threads = 1,
    seed: options.Seed = 0,
    picture: given.LossPicture = None,
    fresh: given.Fresh = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Train a model.

    The result is a folder that --model and `meshmatch models add` accept. After a stop or a kill the same
    command goes on from the checkpoint, exactly. On several GPUs:
    `torchrun --nproc-per-node N -m meshmatch train ...`.
    """
    from meshmatch.errors import needs
    from meshmatch.threads import set_threads

    with needs("torch", "train"):
        from meshmatch.training import train as training
        from meshmatch.training.bodies import Bodies
        from meshmatch.training.pose_files import load_poses
        from meshmatch.training.recipes import recipe_for

    set_threads(threads)
    check_chart(picture)
    make_folder(output)
    check_writable(picture)
    first = os.environ.get("RANK", "0") == "0"  # of several processes on several GPUs one speaks
    console = Console(quiet or not first)
    recipe = recipe_for(shapes, preset, unsupervised).changed(
        field=field, blend=blend, rate=rate, steps=steps, minutes=minutes, bf16=bf16, workers=workers,
        threads=threads, seed=seed,
    )  # fmt: skip
    known = None if poses is None else load_poses(poses, pose_share)
    bodies = Bodies(template, identities, known) if shapes is None or known is not None else None
    facts = training.CardFacts(name or "", category or "", "", licence, stiffness, start)
    if not fresh and training.checkpoint_in(output).is_file():
        console.say(f"going on from the checkpoint in {output}; --fresh starts anew")
    reports: list[StepReport] = []

    def report(now: "StepReport") -> None:
        reports.append(now)
        if len(reports) == 1 or now.validation is not None or now.step == now.steps:
            console.say(f"{now.words} ({now.seconds:.0f} s)")

    with console.progress() as progress:
        training.train(
            output, shapes=shapes, bodies=bodies, recipe=recipe, facts=facts, resume=not fresh,
            progress=progress, report=report,
        )  # fmt: skip
    if first:
        _picture(console, picture, reports)
        _summary(console, output, recipe.train.steps, picture, json)


def _picture(console: Console, picture: "Path | None", reports: "list[StepReport]") -> None:
    if picture is not None and not reports:
        console.say(f"{picture} was not drawn: the run ended before its first report")
    elif picture is not None:
        from meshmatch.render.charts import draw_losses

        names = dict.fromkeys(name for now in reports for name in now.terms)
        terms = {name: [now.terms.get(name, float("nan")) for now in reports] for name in names}
        known = {now.step: now.validation for now in reports if now.validation is not None}
        draw_losses(picture, [now.step for now in reports], terms, known)
        console.say(f"drew {picture}: the losses over the steps")


def _summary(console: Console, output: "Path", steps: int, picture: "Path | None", json: bool) -> None:
    from meshmatch.models.registry import CARD, read_card

    card = read_card(output / CARD)
    console.say(
        f"wrote model {card.name}, learned from {card.data}, to {output} after step {card.steps}; use it with "
        f"--model {output}, or add it: meshmatch models add {output}"
    )
    if card.steps < steps:
        console.say(f"unfinished: step {card.steps:,} of {steps:,}; the same command goes on")
    if json:
        print_json(
            {
                "output": str(output),
                "picture": None if picture is None else str(picture),
                "model": card.name,
                "steps": card.steps,
                "training_minutes": card.training_minutes,
                "metrics": card.metrics,
            }
        )
