"""``meshmatch view``."""

from pathlib import Path
from typing import Annotated

import typer

from meshmatch.cli import options, transfer_options
from meshmatch.cli.console import Console, print_json
from meshmatch.cli.options import RunOptions, grouped


@grouped
def view(
    source: options.Source,
    target: options.Target,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="PAGE", help="The page: one .html file.")],
    maps: transfer_options.ViewMapOptions,
    run: RunOptions,
) -> None:
    """Make a page that shows two shapes and the map between them.

    Corresponding points have one colour; point at one shape and see the place on the other. The page is a single file
    for any recent browser and needs no network. With --map, --up and --front give the orientation of SOURCE.
    """
    from meshmatch.api.pictures import view as viewed
    from meshmatch.render.viewer import check_page

    check_page(output)
    transfer = transfer_options.Transfer(source, target, maps, run, Console(run.quiet))
    with transfer.outputs([output], []) as (temporary,):
        page = viewed(source, target, temporary, transfer, up=maps.up, front=maps.front, names=transfer.names)
    for note in page.notes:
        transfer.console.say(note)
    transfer.console.say(f"wrote {output} ({page.size / 1e6:.1f} MB): open it in a browser")
    if run.json:
        record = transfer.record(page.maps, float(page.maps.forward.confidence.mean()))
        print_json({"output": output} | record | {"drawn_vertices": list(page.drawn), "bytes": page.size})
