"""``meshmatch train``: train a model from shapes."""

import math
import os
import shlex
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from typer import Option

import meshmatch
from meshmatch.cli.options import (
    Json,
    Options,
    Quiet,
    Seed,
    Threads,
    check_outputs,
    check_writable,
    grouped,
    optional,
    output_option,
)
from meshmatch.cli.user_messages import Console, print_json
from meshmatch.errors import InputError, OptionError, needs
from meshmatch.models.card import ModelCard
from meshmatch.models.registry import NO_MODEL, read_any_card
from meshmatch.progress import ProgressCallback
from meshmatch.threads import set_threads

if TYPE_CHECKING:
    from meshmatch.generators.bodies import Bodies
    from meshmatch.generators.kinds import Kind
    from meshmatch.implicit.network import Deformation
    from meshmatch.models.trained import TrainedModel
    from meshmatch.templates.prepared_folder import RegisteredShapes
    from meshmatch.training.loop import StepReport
    from meshmatch.training.recipes import Recipe

_FALLING = 0.99  # the validation error is still falling if it is below this factor of an earlier one,
_MAX_EARLIER = 0.9  # which was measured at this share of the steps at the latest
_FORECAST_AFTER = 10.0  # seconds of training after which its duration is estimated
_CODE_STEP = 0.06  # cost of a step of the latent code search of a pointwise model, in training steps
_ENERGIES = ("volume", "arap", "blend")
_IMPLICIT = (
    *("implicit", "preset", "shapes", "field", "rate", *_ENERGIES, "name", "category", "licence", "steps"),
    *("minutes", "workers", "threads", "seed", "picture", "fresh"),
)


@dataclass(frozen=True)
class TrainOptions(Options):
    """Options of the training."""

    template: str | None = optional(
        "NAME",
        "An included template (human-T, human-A, human-I, human-T-300), or a template file. Default: human-T; with "
        "--preset paper human-T-300, which has the paper's 300 nodes.",
    )
    shapes: Path | None = optional(
        "FOLDER",
        "Train on a folder that `meshmatch prepare` wrote, with its template; or, given a folder that `meshmatch fit` "
        "wrote, continue training its model on the fits that are not poor. Default: generated shapes of --kind.",
    )
    kind: Literal["human", "quadruped", "hand", "head"] | None = Option(
        None,
        help="Train on generated people, four-legged animals, right hands or heads (needs the extra `train`). "
        "Default: human.",
    )
    implicit: bool = Option(
        False,
        "--implicit",
        help="Train an implicit model for `match` and `interpolate`: signed distances of a folder of watertight meshes, "
        "clouds or .npz samples that share an orientation, such as chairs (needs the extra `implicit`). --field: mls or "
        "pointwise.",
    )
    unsupervised: bool = Option(False, "--unsupervised", help="Ignore the correspondence of registered shapes.")
    preset: Literal["default", "paper"] = Option(
        "default",
        help="Training settings. default: the best in our measurements; paper: the paper's (with --implicit, DIF-Net's, "
        "for either --field).",
    )
    recipe: Path | None = optional(
        "FILE",
        "Use the settings of another model: the card.json in its folder, or a part of one. Other options override single "
        "settings; minutes, threads and device are not taken from it.",
    )
    field: Literal["mls", "rbf", "pointwise"] | None = Option(
        None,
        help="Representation of the deformation: moving least squares (mls, the default) or radial basis functions "
        "(rbf) on nodes, or a network evaluated at every point (pointwise), which is slow and is refined by its "
        "latent code.",
    )
    start: str | None = optional(
        "MODEL", "Start from the weights of a trained model with the same template and preset."
    )
    rate: float | None = Option(None, min=0.0, help="Learning rate. Default: the preset's.")
    volume: float | None = Option(
        None, min=0.0, metavar="WEIGHT", help="Weight of the volume loss (lambda_2 in the paper)."
    )
    arap: float | None = Option(
        None, min=0.0, metavar="WEIGHT", help="Weight of the rigidity loss (lambda_3 in the paper)."
    )
    blend: float | None = Option(
        None,
        metavar="WEIGHT",
        min=0.0,
        help="Weight of both losses at blends of two latent codes (lambda_4 in the paper); 1 for models that are used "
        "with `interpolate --blend codes`. Default: the preset's.",
    )
    stiffness: float = Option(
        1.0,
        min=1e-6,
        max=1e6,
        help="How strongly jointly refined fits are kept at a common stretch of the template; stored on the card. 1 suits "
        "bodies; 0.05 suits shapes that differ more, such as organs.",
    )
    name: str | None = optional("NAME", "The model's name. Default: the folder's.")
    category: str | None = optional(
        "NAME", "The category of shapes that the model matches. Default: --kind, or with --shapes the model's name."
    )
    licence: str = Option("unstated", help="Terms of use of the weights; stored on the card.")
    steps: int | None = Option(None, min=1, help="Training steps. Default: the preset's.")
    minutes: float | None = Option(
        None, min=0.0, help="Stop after this many minutes; the same command continues later."
    )
    points: int | None = Option(None, min=64, help="Points sampled per training scan. Default: the preset's.")
    identities: int | None = Option(
        None,
        min=1,
        max=1_000_000,
        help="Number of different people or animals among the generated shapes. Default: 4096 people for --kind human, "
        "else 1024.",
    )
    bodies: int | None = Option(
        None,
        min=0,
        help="Number of bodies that are generated once and reused; 0 generates new ones throughout. Default: 0; with "
        "--preset paper 1,000.",
    )
    characters: float | None = Option(
        None,
        min=0.0,
        max=1.0,
        metavar="SHARE",
        help="Share of bodies that wear clothes, are children, stylised or made of parts; most others are naked "
        "adults. Default: 0.5; with --preset paper 0.",
    )
    stylised: float | None = Option(
        None,
        min=0.0,
        max=1.0,
        metavar="SHARE",
        help="Share of the --characters with cartoon proportions. Default: 0.15.",
    )
    poses: Path | None = optional("FILE", "Poses to mix with the sampled ones: .npz, .json or .csv (docs/formats.md).")
    pose_share: float = Option(
        0.5, min=0.0, max=1.0, help="Share of the bodies with a pose from --poses, of those not from --mhr."
    )
    mhr: Path | None = optional(
        "FOLDER",
        "Mix in bodies of Meta's Momentum Human Rig, whose shapes were learned from scans: lod3.fbx and compact_v6_1.model "
        "of its releases (github.com/facebookresearch/MHR).",
    )
    mhr_share: float = Option(0.5, min=0.0, max=1.0, help="Share of the bodies from --mhr.")
    bf16: bool | None = Option(None, "--bf16/--no-bf16", help="bfloat16 arithmetic. Default: the preset's choice.")
    tf32: bool | None = Option(
        None,
        "--tf32/--no-tf32",
        help="TensorFloat-32 matrix products, on GPUs that support them. Default: the preset's choice.",
    )
    compile: bool | None = Option(
        None, "--compile/--no-compile", help="Compile the loss with torch, which takes a minute or two. Default: no."
    )
    device: Literal["auto", "cpu", "cuda", "mps"] = Option(
        "auto", help="Where the network is trained. auto: a CUDA GPU if there is one, else the CPU."
    )
    draw: Literal["auto", "cpu", "device"] = Option(
        "auto",
        help="Where training batches are generated: by --workers on the CPU, or on the --device. auto: on the device if it "
        "is a CUDA GPU, else on the CPU.",
    )
    workers: int | None = Option(
        None, min=0, help="Number of processes that generate batches on the CPU. Default: the preset's."
    )
    threads: Threads = 1
    seed: Seed = 0
    validate: Path | None = optional(
        "FOLDER",
        "Measure the validation error on the registered shapes of another folder that `meshmatch prepare` wrote with the "
        "same template. Default: on further samples of the training data.",
    )
    tensorboard: bool = Option(
        False, "--tensorboard", help="Also write curves for TensorBoard (needs the extra `tensorboard`)."
    )
    picture: Path | None = optional("FILE", "Plot the losses of this run: .png, .svg or .pdf.")
    fresh: bool = Option(False, "--fresh", help="Start again instead of continuing from the folder's checkpoint.")


@grouped
def train(
    *,
    output: Path = output_option("FOLDER", "The model folder; also holds the checkpoint."),
    how: TrainOptions,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Train a model.

    The result is a folder that --model and `meshmatch models add` accept. After an interruption the same command
    continues exactly from the checkpoint. On several GPUs: `torchrun --nproc-per-node N -m meshmatch train ...`.
    """
    with needs("torch", "train"):
        from meshmatch.training.train import CHECKPOINT

    set_threads(how.threads)
    check_outputs([how.shapes, how.validate, how.mhr], output)
    if how.picture is not None:
        from meshmatch.render.charts import check_chart

        check_chart(how.picture)
        if how.picture.resolve().parent != output.resolve():  # that folder does not exist yet
            check_writable(how.picture)
    first = os.environ.get("RANK", "0") == "0"  # of several processes on several GPUs, only one prints
    console = Console(quiet or not first)
    steps, learn, then = (_plan_implicit if how.implicit else _plan_explicit)(output, how, console)
    if not how.fresh and (output / CHECKPOINT).is_file():
        console.say(f"continuing from the checkpoint in {output}; --fresh starts again")
    reports: list[StepReport] = []

    def report(now: "StepReport") -> None:
        reports.append(now)
        if len(reports) == 1 or now.validation is not None or now.step == now.steps:
            console.say(f"{now.words} ({now.seconds:.0f} s{_time_left(reports)})")

    with console.progress() as progress:
        try:
            learn(resume=not how.fresh, progress=_forecast(console, progress, steps, how, then), report=report)
        except KeyboardInterrupt:
            if (output / CHECKPOINT).is_file():
                console.say("stopped; the same command continues from the checkpoint")
            raise
        if first and how.shapes is not None and then is not None:
            _calibrate(console, output, how.shapes, how.threads, progress)
    if first:
        if how.picture is not None:
            _draw(console, how.picture, reports)
        _summary(console, output, steps, reports, how.picture, json)


def _forecast(
    console: Console, progress: ProgressCallback, steps: int, how: TrainOptions, then: "Recipe | None"
) -> ProgressCallback:
    """Wrap the progress callback: after the first steps, print how long the training and the calibration will take."""
    from meshmatch.api.calibration import DEFAULT_COUNT, SEARCH_STEPS, list_shapes
    from meshmatch.fields.shape_functions import has_nodes

    began: tuple[float, float] | None = None
    is_printed = False

    def report(stage: str, name: str, share: float) -> None:
        nonlocal began, is_printed
        progress(stage, name, share)
        if is_printed or name != "training" or not stage.startswith("step"):
            return
        now = time.monotonic()
        if began is None:  # the first step waits for its batch
            began = now, share
        elif now - began[0] >= _FORECAST_AFTER and share > began[1]:
            each = (now - began[0]) / (share - began[1]) / steps
            left = each * steps * (1 - share) / 60
            durations = [_about(left if how.minutes is None else min(left, how.minutes), "of training")]
            if then is not None and how.shapes is not None:
                fits = min(DEFAULT_COUNT, len(list_shapes(how.shapes)))
                what = f"to fit {fits} of the shapes, to calibrate the verdicts"
                pointwise = not has_nodes(then.network.field)
                durations.append(_about(each * fits * SEARCH_STEPS * _CODE_STEP / 60 if pointwise else 0, what))
            console.say(", then ".join(durations))
            is_printed = True

    return report


def _about(minutes: float, what: str) -> str:
    return f"{f'about {minutes:.0f} min' if minutes >= 1 else 'less than a minute'} {what}"


def _calibrate(console: Console, output: Path, shapes: Path, threads: int, progress: ProgressCallback) -> None:
    """Calibrate the verdicts of a model that was trained without correspondence."""
    console.say("fitting some of the shapes, to calibrate the verdicts of the model")
    began = time.monotonic()

    def counted(stage: str, name: str, share: float) -> None:
        progress(stage, name, share)
        left = (time.monotonic() - began) * (1 - share) / share / 60 if stage == "shapes" else 0
        if left >= 1:
            console.say(f"fitted {name}{_format_time_left(left)}")

    try:
        usual = meshmatch.calibrate(output, shapes, threads=threads, progress=counted).metrics["usual"]
    except InputError as error:
        console.say(f"note: the model is not calibrated, and none of its fits will be good: {error.message}")
        return
    console.say(
        f"fitted {usual['fits']} of the shapes: the template is stretched {math.exp(usual['stretch']):.2f}-fold and lies "
        f"{100 * usual['residual']:.2g} % of sqrt(area) from them (medians); other fits are judged relative to that"
    )


def _time_left(reports: "list[StepReport]") -> str:
    """Text on the remaining training time, extrapolated from the reports; empty if it is unknown or over."""
    first, now = reports[0], reports[-1]
    if now.step in (first.step, now.steps):
        return ""
    return _format_time_left((now.seconds - first.seconds) / (now.step - first.step) * (now.steps - now.step) / 60)


def _format_time_left(minutes: float) -> str:
    return f", about {minutes:.0f} min left" if minutes >= 1 else ", less than a minute left"


def _plan_explicit(
    output: Path, how: TrainOptions, console: Console
) -> "tuple[int, Callable[..., Any], Recipe | None]":
    """Plan the training of an explicit model, with a template mesh.

    Return the number of steps, the function that trains, and the recipe if the model has to be calibrated afterwards.
    """
    from meshmatch.models.inference import training_device
    from meshmatch.training import train as training
    from meshmatch.training.recipes import fine_tuning, recipe_for, small_data

    settings = (
        "field", "volume", "arap", "blend", "rate", "points", "steps", "minutes", "bf16", "tf32", "compile", "workers",
        "threads", "device", "draw", "seed",
    )  # fmt: skip
    fitted, start = _fits(how, console)
    if fitted is None:
        if how.shapes is not None:
            how.refuse(("template", "identities"), "a prepared folder, which has a template and shapes of its own")
        recipe = recipe_for(how.shapes, how.preset, how.unsupervised, how.kind)
    else:
        recipe = small_data() if start is None else fine_tuning(start)
    changes = {name: getattr(how, name) for name in settings}
    if how.recipe is not None:
        from meshmatch.training.recipe_files import read_recipe

        how.refuse(("preset",), "--recipe")
        recipe = read_recipe(how.recipe, recipe, started=(start or how.start) is not None)
        changes = {name: value for name, value in changes.items() if name in (*how.given, "threads", "device", "draw")}
    recipe = recipe.changed(**changes)
    training_device(wanted=recipe.train.device)  # check it before shapes are generated
    facts = training.CardFacts(how.name or "", how.category or "", "", how.licence, how.stiffness, start or how.start)
    shapes, kind = fitted or how.shapes, _generated(how)
    learn = partial(training.train, output, shapes=shapes, kind=kind, recipe=recipe, facts=facts)
    then = None if recipe.train.loss.needs_correspondence else recipe
    return recipe.train.steps, partial(learn, validation=how.validate, tensorboard=how.tensorboard), then


def _plan_implicit(output: Path, how: TrainOptions, console: Console) -> tuple[int, Callable[..., Any], None]:
    """Plan the training of an implicit model; results as in `_plan_explicit`."""
    how.refuse(sorted({each.name for each in fields(how)}.difference(_IMPLICIT)), "--implicit")
    if how.shapes is None or how.field == "rbf":
        raise OptionError("--implicit needs --shapes, and the field mls or pointwise", "give a folder of shapes")
    published = how.preset == "paper"
    field: Deformation = "mls" if how.field == "mls" or not (how.field or published) else "pointwise"
    if field == "pointwise":  # DIF-Net's deformation; these energies belong to mls
        how.refuse(_ENERGIES, f"--implicit {'--field pointwise' if how.field else '--preset paper'}")
    with needs("torch", "implicit"):
        from meshmatch.implicit.network import ImplicitConfig
        from meshmatch.implicit.training import AS_PUBLISHED, DIF_NET, TRAINING, train_implicit
        from meshmatch.training.train import CardFacts
    usual = AS_PUBLISHED if published else TRAINING
    loss, chosen = (
        {name: value for name in names if (value := getattr(how, name)) is not None}
        for names in (_ENERGIES, ("rate", "steps", "workers"))
    )
    training = replace(
        usual, minutes=how.minutes, threads=how.threads, seed=how.seed, loss=replace(usual.loss, **loss), **chosen
    )
    config = replace(DIF_NET if published else ImplicitConfig(), field=field)
    facts = CardFacts(how.name or "", how.category or "", "", how.licence)
    learn = partial(train_implicit, output, how.shapes, config=config, training=training, facts=facts)
    return training.steps, learn, None


def _fits(how: TrainOptions, console: Console) -> "tuple[RegisteredShapes | None, TrainedModel | None]":
    """The shapes of a folder of fits, and the model to continue training (None for fits without a model).

    (None, None) if --shapes is not a folder of fits.
    """
    from meshmatch.collections.select_setting import is_collection

    if how.shapes is None or not is_collection(how.shapes):
        return None, None
    from meshmatch.api.inputs import as_model
    from meshmatch.collections.collection import Collection

    if how.preset != "default" or how.unsupervised:
        name = "--unsupervised" if how.unsupervised else f"--preset {how.preset}"
        raise OptionError(f"{name} does not go with fits", "fits have correspondence; leave it out")
    how.refuse(
        ("template", "poses", "characters", "stylised", "identities", "bodies", "mhr"),
        "fits, but with generated shapes",
    )
    collection = Collection(how.shapes)
    found = collection.to_learn()
    if collection.model == NO_MODEL:
        if how.start is not None:
            hint = "fit the shapes with it first (`meshmatch fit ... --model`), and train on those fits"
            raise OptionError(f"{how.shapes} contains fits without a model, which --start cannot continue", hint)
        console.say(f"training on {len(found.verts)} of {len(collection.names)} fits in {how.shapes}")
        return found, None
    start = as_model(how.start or collection.model)
    console.say(
        f"continuing the training of {start.card.name}, with {len(found.verts)} of {len(collection.names)} "
        f"fits in {how.shapes}"
    )
    return found, start


def _generated(how: TrainOptions) -> "Kind | Bodies | None":
    """The generated shapes to train on; None with --shapes, unless options of generated bodies are given too."""
    from meshmatch.generators.bodies import Bodies
    from meshmatch.generators.kinds import Kind
    from meshmatch.generators.pose_files import load_poses

    if how.kind not in (None, "human"):
        human = ("template", "poses", "characters", "stylised", "bodies", "mhr")
        how.refuse(human, f"--kind {how.kind}, but with human bodies")
        return Kind(str(how.kind), how.identities or Kind.identities)
    known = None if how.poses is None else load_poses(how.poses, how.pose_share)
    scanned = None
    if how.mhr is not None:
        from meshmatch.api.scanned import scanned_bodies

        scanned = scanned_bodies(how.mhr, how.mhr_share, how.template)
    choices = how.kind, known, how.characters, how.bodies, scanned, how.stylised
    if how.shapes is not None and all(each is None for each in choices):
        return None
    return Bodies(how.template, how.identities or Bodies.identities, *choices[1:])


def _draw(console: Console, picture: Path, reports: "list[StepReport]") -> None:
    """Plot the losses of a run."""
    if not reports:
        console.say(f"{picture} was not drawn: the run ended before its first report")
        return
    from meshmatch.render.charts import draw_losses

    names = dict.fromkeys(name for now in reports for name in now.terms)
    terms = {name: [now.terms.get(name, float("nan")) for now in reports] for name in names}
    known = {now.step: now.validation for now in reports if now.validation is not None}
    draw_losses(picture, [now.step for now in reports], terms, known)
    console.say(f"drew {picture}: the losses over the steps")


def _summary(
    console: Console, output: Path, steps: int, reports: "list[StepReport]", picture: Path | None, json: bool
) -> None:
    """Print a summary of the trained model."""
    card = read_any_card(output)
    if isinstance(card, ModelCard) and (distance := card.metrics.get("validation", {}).get("distance")):
        before = [
            now.validation for now in reports if now.validation is not None and now.step <= _MAX_EARLIER * card.steps
        ]
        falls = f", {'still falling' if distance < _FALLING * before[-1] else 'no longer falling'}" if before else ""
        on = card.recipe.get("validation") or "shapes that were not trained on"
        console.say(f"validation error: {100 * distance:.2g} % of sqrt(area) on {on}{falls}")
    own = shlex.quote(str(output))
    console.say(
        f"wrote model {card.name}, trained on {card.data}, to {output} after step {card.steps}; use it with "
        f"--model {own}, or add it: meshmatch models add {own}"
    )
    if card.steps < steps:
        console.say(f"unfinished: step {card.steps:,} of {steps:,}; the same command continues")
    if json:
        record = {"output": output, "picture": picture, "model": card.name, "steps": card.steps}
        found = {"metrics": card.metrics} if isinstance(card, ModelCard) else {"shapes": len(card.shapes)}
        print_json(record | {"training_minutes": card.training_minutes} | found)
