"""``meshmatch match``."""

from pathlib import Path
from typing import Annotated

import typer

from meshmatch.cli import options, words
from meshmatch.cli.console import Console, print_json
from meshmatch.cli.options import PairOptions, RunOptions, grouped
from meshmatch.cli.output_paths import check_distinct, check_png, claimed


@grouped
def match(
    source: options.Source,
    target: options.Target,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="MAP",
            help="The map; its suffix chooses the format: .npy .npz .csv .txt .mat .json.",
        ),
    ],
    how: PairOptions,
    run: RunOptions,
    picture: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Draw both shapes, corresponding points in one colour.")
    ] = None,
) -> None:
    """Match every vertex of one shape to another.

    The two files may differ in vertex count, unit, up axis and orientation. In the map, index[i] is the vertex of the
    target matched to vertex i of the source; vertices are counted from 0, in the order of the files.
    """
    from meshmatch.maps.files import check_suffix, save_map
    from meshmatch.models.registry import locate_model
    from meshmatch.outputs import replace_on_success
    from meshmatch.shapes.files import load_shape

    how.check()
    check_suffix(output)
    check_png(picture)
    check_distinct([output, picture], [source, target, how.known_pairs])
    console, names = Console(run.quiet), words.names_of([source, target])
    # What cannot be written, a mistyped model and broken files are told before the long work.
    with claimed(picture) as drawing:
        with replace_on_success(output) as temporary:
            locate_model(how.model)
            shapes = load_shape(source), load_shape(target)
            pairs = how.pairs()
            from meshmatch.api import matching

            with console.progress() as report:
                result = matching.match(
                    *shapes,
                    model=how.model,
                    config=how.configs(),
                    landmarks=pairs,
                    threads=run.threads,
                    progress=report,
                )
            found = result.map
            words.refuse_poor(run.strict, found.verdict, found.reasons)
            save_map(temporary, found)
        if drawing is not None:
            from meshmatch.render.compose import compose_match

            compose_match(*shapes, found, result.rotations).named(names).render(drawing)
    words.tell_match(console, result, names)
    words.tell_verdict(console, found.verdict, found.reasons)
    console.say(
        f"wrote {output}: for each of the {found.source_vertices} vertices of {names[0]} "
        f"its vertex of {names[1]} ({result.seconds:.1f} s)"
    )
    if picture is not None:
        console.say(f"drew {picture}: corresponding points in one colour")
    if run.json:
        print_json({"output": output, "picture": picture} | words.match_record(result, names) | how.record)
