"""``meshmatch train``."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from meshmatch.cli import options
from meshmatch.cli.console import Console, print_json
from meshmatch.cli.output_paths import check_writable
from meshmatch.outputs import make_folder

if TYPE_CHECKING:
    from meshmatch.models.trained import TrainedModel
    from meshmatch.training.loop import Progress
    from meshmatch.training.run import Recipe


def train(
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FOLDER", help="The model folder; also holds the checkpoint."),
    ],
    template: Annotated[
        str,
        typer.Option(
            metavar="NAME", help="A bundled template (human-T, human-A, human-I), or a bundle's file."
        ),
    ] = "human-T",
    shapes: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Learn from the shapes of a folder that `meshmatch prepare` made, and use its template. Otherwise "
            "from generated human bodies (needs the extra `bodies`).",
        ),
    ] = None,
    unsupervised: Annotated[
        bool,
        typer.Option(
            "--unsupervised",
            help="Learn without correspondence also from registered shapes; others always are.",
        ),
    ] = False,
    preset: Annotated[
        Literal["default", "paper"],
        typer.Option(help="The recipe: what measured best, or the paper's network, losses and rates."),
    ] = "default",
    field: Annotated[
        Literal["mls", "rbf", "pointwise"],
        typer.Option(
            help="How a deformation is represented: by moving least squares or radial basis functions of nodes, or by a "
            "network at every point, which is slow. --refine nodes means the code for the last."
        ),
    ] = "mls",
    start: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL", help="Begin with the weights of a trained model of the same template and preset."
        ),
    ] = None,
    rate: Annotated[
        float | None, typer.Option(min=0.0, help="Learning rate; the preset's if not given.")
    ] = None,
    blend: Annotated[
        float | None,
        typer.Option(
            metavar="WEIGHT",
            min=0.0,
            help="Weight of volume and rigidity of what lies between two codes: the paper's l4, 1 for models that "
            "interpolate by codes. The preset's if not given.",
        ),
    ] = None,
    stiffness: Annotated[
        float,
        typer.Option(
            min=1e-6,
            help="How firmly two fits hold a common stretch of the template; goes onto the card. 1 suits bodies; 0.05 "
            "what differs more from shape to shape, such as organs.",
        ),
    ] = 1.0,
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="The model's name; the folder's if not given.")
    ] = None,
    category: Annotated[
        str | None, typer.Option(help="What it matches: human, or the name of the folder of shapes.")
    ] = None,
    licence: Annotated[
        str, typer.Option(help="Under which terms the weights may be used; goes onto the card.")
    ] = "unstated",
    steps: Annotated[
        int | None, typer.Option(min=1, help="Training steps; the preset's if not given.")
    ] = None,
    minutes: Annotated[
        float | None, typer.Option(min=0.0, help="Stop after so long, with a checkpoint to go on from.")
    ] = None,
    identities: Annotated[int, typer.Option(min=1, help="How many different bodies are generated.")] = 4096,
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Poses to mix with the sampled ones: .npz, .json or .csv (docs/formats.md)."
        ),
    ] = None,
    pose_share: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Share of the bodies that stand in a pose of --poses.")
    ] = 0.5,
    bf16: Annotated[
        bool | None,
        typer.Option("--bf16/--no-bf16", help="bfloat16 arithmetic; the preset's choice if not given."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=0, help="Processes that draw batches; the preset's if not given.")
    ] = None,
    threads: options.Threads = 1,
    seed: options.Seed = 0,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw the losses of this run over its steps: .png, .svg or .pdf."),
    ] = None,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Start anew instead of going on from the folder's checkpoint.")
    ] = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Train a model.

    The result is a folder that --model and `meshmatch models add` accept. After a stop or a kill the same
    command goes on from the checkpoint, exactly. On several GPUs:
    `torchrun --nproc-per-node N -m meshmatch train ...`.
    """
    from meshmatch.errors import OptionError
    from meshmatch.threads import set_threads

    set_threads(threads)
    first = os.environ.get("RANK", "0") == "0"  # of several processes on several GPUs one speaks
    if picture is not None:
        from meshmatch.render.charts import check_chart

        check_chart(picture)
    make_folder(output)
    check_writable(picture)
    from meshmatch.models.card import check_name
    from meshmatch.templates.unregistered import is_registered
    from meshmatch.training import run
    from meshmatch.training.folder import checkpoint_in
    from meshmatch.training.small_data import few_recipe, frame_of_few
    from meshmatch.training.unsupervised import cloud_recipe

    label = check_name(name or output.resolve().name)
    clouds = shapes is not None and (unsupervised or not is_registered(shapes))
    if unsupervised and shapes is None:
        raise OptionError("--unsupervised learns from a folder of shapes", "name it with --shapes")
    few = None if shapes is None or clouds or preset != "default" else frame_of_few(shapes)
    chosen = cloud_recipe(preset) if clouds else run.recipe(preset) if few is None else few_recipe()
    preset_train = chosen.train
    settings = replace(
        preset_train,
        steps=preset_train.steps if steps is None else steps,
        bf16=preset_train.bf16 if bf16 is None else bf16,
        workers=preset_train.workers if workers is None else workers,
        rate=preset_train.rate if rate is None else rate,
        loss=preset_train.loss if blend is None else replace(preset_train.loss, blend=blend),
        minutes=minutes,
        threads=threads,
        seed=seed,
    )
    chosen = replace(chosen, train=settings, network=replace(chosen.network, field=field))
    voice = Console(quiet or not first)
    if not fresh and checkpoint_in(output).is_file():
        voice.say(f"going on from the checkpoint in {output}; --fresh starts anew")
    started = None
    if start is not None:
        from meshmatch.models.trained import load_model

        started = load_model(start)
    given = None
    if poses is not None:
        from meshmatch.training.pose_files import load_poses

        if shapes is not None:
            raise OptionError("poses are for generated bodies, not for --shapes", "leave out one of the two")
        given = load_poses(poses, pose_share)
    if shapes is not None and clouds:
        with _progress(voice, picture if first else None) as show:
            folder = _without_correspondence(
                shapes, output, chosen, label, category, licence, started, not fresh, stiffness, voice, show
            )
        return _done(folder, label, voice, json and first, picture)
    if shapes is not None:
        made = run.read_template(shapes / "template.safetensors")
        source, count = run.folder_source(shapes, made, warped=few is not None)
        data = f"{count} registered shapes of {shapes.resolve().name}"
        kind = category or shapes.resolve().name
    else:
        made = run.read_template(template)
        with voice.progress() as report:
            source = run.human_source(
                made,
                identities,
                seed,
                lambda done, total: report("making bodies (once)", "bodies", done / total),
                given,
            )
        data = f"{identities} generated bodies in sampled poses (anny, Apache-2.0; MakeHuman data, CC0)"
        if given is not None and poses is not None:
            data += f", {given.share:.0%} of them in {given.P} poses of {poses.name}"
        kind = category or "human"
    with _progress(voice, picture if first else None) as show:
        folder = run.train_model(
            made,
            source,
            output,
            recipe=chosen,
            name=label,
            category=kind,
            data=data,
            licence=licence,
            start=started,
            resume=not fresh,
            frame=few,
            stiffness=stiffness,
            progress=show,
        )
    _done(folder, label, voice, json and first, picture)


def _without_correspondence(
    shapes: Path,
    output: Path,
    recipe: "Recipe",
    name: str,
    category: str | None,
    licence: str,
    start: "TrainedModel | None",
    resume: bool,
    stiffness: float,
    voice: Console,
    show: "Callable[[Progress], None]",
) -> Path:
    from meshmatch.templates.unregistered import read_gathered
    from meshmatch.training import run
    from meshmatch.training.unsupervised import train_clouds

    made = run.read_template(shapes / "template.safetensors")
    gathered = read_gathered(shapes, made)
    count, known = len(gathered.points), len(gathered.template_landmarks)
    help = f" and {known} known points" if known else ""
    voice.say(f"learning from {count} shapes without correspondence{help}")
    return train_clouds(
        made,
        gathered,
        output,
        recipe=recipe,
        name=name,
        category=category or shapes.resolve().name,
        data=f"{count} shapes of {shapes.resolve().name}, without correspondence{help}",
        licence=licence,
        start=start,
        resume=resume,
        stiffness=stiffness,
        progress=show,
    )


def _done(folder: Path, label: str, voice: Console, json: bool, picture: Path | None) -> None:
    from meshmatch.models.registry import CARD, read_card

    if voice.quiet and not json:
        return  # or one of several processes, which has not written the card
    card = read_card(folder / CARD)
    voice.say(
        f"wrote model {label} to {folder} after step {card.steps}; use it with --model {folder}, or add it: "
        f"meshmatch models add {folder}"
    )
    if json:
        print_json(
            {
                "output": str(folder),
                "picture": None if picture is None else str(picture),
                "model": card.name,
                "steps": card.steps,
                "training_minutes": card.training_minutes,
                "metrics": card.metrics,
            }
        )


@contextmanager
def _progress(voice: Console, picture: Path | None) -> "Iterator[Callable[[Progress], None]]":
    """A bar with the losses while people watch; a line now and then where they read a log; at the end a picture."""
    lines = 0
    seen: list[Progress] = []

    with voice.progress() as report:

        def show(now: "Progress") -> None:
            nonlocal lines
            seen.append(now)
            words = ", ".join(f"{name} {value:.4g}" for name, value in now.terms.items())
            if now.validation is not None:
                words += f", validation {now.validation:.4f}"
            report(f"step {now.step} of {now.steps}: {words}", "training", now.step / now.steps)
            if now.validation is not None or now.step == now.steps or lines == 0:
                lines += 1
                voice.say(f"step {now.step} of {now.steps} ({now.seconds:.0f} s): {words}")

        yield show
    if picture is not None and not seen:
        voice.say(f"{picture} was not drawn: the run ended before its first report")
    elif picture is not None:
        from meshmatch.render.charts import draw_losses

        names = dict.fromkeys(name for now in seen for name in now.terms)
        terms = {name: [now.terms.get(name, float("nan")) for now in seen] for name in names}
        known = {now.step: now.validation for now in seen if now.validation is not None}
        draw_losses(picture, [now.step for now in seen], terms, known)
        voice.say(f"drew {picture}: the losses over the steps")
