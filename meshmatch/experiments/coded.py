"""3D-CODED, a rival: the paper's point encoder, a decoder of template points, and no constraint on what it answers.

After *3D-CODED: 3D correspondences by deep deformation* (ECCV 2018), from the parts that the project has: the preset
`paper` with a pointwise field, its loss the squared distance to known partners alone. Trained like the other learned
rival, `meshmatch.experiments.transmatch`: on generated bodies, upright and turned about the vertical, for a stated time:

    python -m meshmatch.experiments.coded --steps 1500 --minutes 8 -o coded

``--steps`` fixes the schedule and ``--minutes`` stops a run; the same command goes on from where it stopped. The
benchmark of rivals takes the folder with ``--coded``, and searches the code by the Chamfer distance there.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from meshmatch.errors import MeshmatchError
from meshmatch.experiments.report import circumstances, explain
from meshmatch.models.registry import CARD, read_card
from meshmatch.templates.template import read_template
from meshmatch.threads import set_threads
from meshmatch.training.bodies import human_source
from meshmatch.training.loop import StepReport
from meshmatch.training.recipes import Recipe, paper
from meshmatch.training.scans import ScanConfig
from meshmatch.training.train import CardFacts, train_model

TEMPLATE = "human-T"


def coded_recipe(
    steps: int,
    minutes: float | None,
    shapes: int,
    points: int,
    width: int,
    *,
    bf16: bool,
    threads: int,
    seed: int,
) -> Recipe:
    """The preset `paper`, pointwise and without constraints; scans as rough as those of the other learned rival.

    Raises
    ------
    OptionError
        A count that cannot be.
    """
    preset = paper()
    train = replace(
        preset.train,
        steps=steps,
        decay=0.5,
        minutes=minutes,
        shapes=shapes,
        workers=0,
        bf16=bf16,
        threads=threads,
        seed=seed,
        loss=replace(preset.train.loss, volume=0.0, arap=0.0, blend=0.0),
    )
    network = replace(preset.network, field="pointwise", width=width)
    return Recipe(network, train, ScanConfig(points=points, partial=0.0, upright=True), preset.kernel)


def main(words: Sequence[str] | None = None) -> int:
    """Train on generated bodies; 0 when it ran, 1 when a choice or the disk stopped it."""
    parser = argparse.ArgumentParser(
        "python -m meshmatch.experiments.coded",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("coded"), help="the model's folder")
    parser.add_argument("--steps", type=int, default=1500, help="of the whole training: %(default)s")
    parser.add_argument("--minutes", type=float, help="of this run at most; the same command goes on")
    parser.add_argument("--identities", type=int, default=1024, help="people that bodies are blended from")
    parser.add_argument("--shapes", type=int, default=8, help="in a batch: %(default)s")
    parser.add_argument("--points", type=int, default=512, help="of a scan in training: %(default)s")
    parser.add_argument("--width", type=int, default=512, help="of the decoder: %(default)s")
    parser.add_argument("--bf16", action="store_true", help="bfloat16 arithmetic")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(words)
    if min(options.points, options.identities) < 1 or options.seed < 0:
        parser.error("points and identities of 1 or more and a seed of 0 or more are needed")
    console = Console(stderr=True)
    try:
        chosen = coded_recipe(
            options.steps,
            options.minutes,
            options.shapes,
            options.points,
            options.width,
            bf16=options.bf16,
            threads=options.threads,
            seed=options.seed,
        )
        set_threads(options.threads)
        template = read_template(TEMPLATE)
        source = human_source(template, options.identities, options.seed)

        def tell(now: StepReport) -> None:
            error = now.terms["error_code"]
            console.print(f"step {now.step} of {now.steps}, distance {error:.4f}", highlight=False)

        data = (
            f"{options.identities} generated bodies in sampled poses (anny, Apache-2.0; MakeHuman data, CC0)"
        )
        facts = CardFacts("coded", "human", data, licence="")
        folder = train_model(template, source, options.output, chosen, facts, report=tell)
        card = read_card(folder / CARD)
    except MeshmatchError as error:
        explain(error)
        return 1
    record = {
        "steps": card.steps,
        "minutes": card.training_minutes,
        **card.metrics["validation"],
        "network": card.network,
        "train": card.recipe["train"],
        "scan": card.recipe["scan"],
        **circumstances(options.threads, 1),
    }
    print(json.dumps(record), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
