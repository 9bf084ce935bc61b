"""``meshmatch train --implicit``, and the picture of any training."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from meshmatch.cli.options import check_writable, refuse_given
from meshmatch.cli.words import Console, print_json
from meshmatch.errors import OptionError, needs

if TYPE_CHECKING:
    from meshmatch.implicit.network import Deformation
    from meshmatch.training.loop import StepReport

_ENERGIES = ("volume", "arap", "blend")
_IMPLICIT = (
    *("implicit", "preset", "shapes", "field", "rate", *_ENERGIES, "name", "category", "licence", "steps"),
    *("minutes", "workers", "threads", "seed", "picture", "fresh"),
)


def train_shapes(output: Path, how: Any, json: bool, console: Console) -> None:
    """Train an implicit model by the options of `meshmatch train`."""
    refuse_given(how, _IMPLICIT, "--implicit")
    if how.shapes is None or how.field == "rbf":
        raise OptionError("--implicit needs --shapes, and the field mls or pointwise", "give a folder of shapes")
    published = how.preset == "paper"
    field: Deformation = how.field or ("pointwise" if published else "mls")
    if field == "pointwise":  # DIF-Net's deformation: these are energies of the other
        other = "--field pointwise" if how.field else "--preset paper"
        refuse_given(how, set(_IMPLICIT).difference(_ENERGIES), f"--implicit {other}")
    with needs("torch", "implicit"):
        from meshmatch.implicit.network import ImplicitConfig
        from meshmatch.implicit.training import AS_PUBLISHED, DIF_NET, TRAINING, train_implicit
        from meshmatch.models.implicit_card import read_implicit_card
        from meshmatch.training.train import CHECKPOINT, CardFacts
    if how.picture is not None:
        from meshmatch.render.charts import check_chart

        check_chart(how.picture)
    check_writable(how.picture)
    weights = {name: value for name in _ENERGIES if (value := getattr(how, name)) is not None}
    chosen = {name: value for name in ("rate", "steps", "workers") if (value := getattr(how, name)) is not None}
    usual = AS_PUBLISHED if published else TRAINING
    loss = replace(usual.loss, **weights)
    training = replace(usual, minutes=how.minutes, threads=how.threads, seed=how.seed, loss=loss, **chosen)
    facts = CardFacts(how.name or "", how.category or "", "", how.licence)
    if not how.fresh and (output / CHECKPOINT).is_file():
        console.say(f"going on from the checkpoint in {output}; --fresh starts anew")
    reports: list[StepReport] = []
    with console.progress() as progress:

        def report(now: "StepReport") -> None:
            reports.append(now)
            progress(now.words, "training", now.step / now.steps)

        config = replace(DIF_NET if published else ImplicitConfig(), field=field)
        train_implicit(
            output, how.shapes, config=config, training=training, facts=facts, resume=not how.fresh, report=report
        )
    draw_reports(console, how.picture, reports)
    card = read_implicit_card(output)
    console.say(f"wrote implicit model {card.name}, learned from {card.data}, to {output} after step {card.steps}")
    if card.steps < training.steps:
        console.say(f"unfinished: step {card.steps:,} of {training.steps:,}; the same command goes on")
    if json:
        record = {"output": output, "picture": how.picture, "model": card.name, "steps": card.steps}
        print_json(record | {"training_minutes": card.training_minutes, "shapes": len(card.shapes)})


def draw_reports(console: Console, picture: Path | None, reports: "list[StepReport]") -> None:
    """The losses of a run, where a picture is asked for."""
    if picture is not None and not reports:
        console.say(f"{picture} was not drawn: the run ended before its first report")
    elif picture is not None:
        from meshmatch.render.charts import draw_losses

        names = dict.fromkeys(name for now in reports for name in now.terms)
        terms = {name: [now.terms.get(name, float("nan")) for now in reports] for name in names}
        known = {now.step: now.validation for now in reports if now.validation is not None}
        draw_losses(picture, [now.step for now in reports], terms, known)
        console.say(f"drew {picture}: the losses over the steps")
