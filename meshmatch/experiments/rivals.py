"""Other methods on the same pairs with the same metric: ``python -m meshmatch.experiments.rivals``.

Each rival fits and maps the pairs of `meshmatch.experiments.bench`, and is measured as there: no pair is left out, one
that fails counts as the map of everything to vertex 0 and is listed as failed. A method whose package is not installed,
or whose model is not given, is skipped, and the table says so.

- rigid: scaled by area, all orientations tried, nearest vertex.
- zoomout: pyfmaps, HKS and WKS, ZoomOut from 30 to 120 eigenfunctions; meshes thinned to 10,000 triangles.
- nricp: trimesh's non-rigid ICP, source onto target from the rigid alignment; the source thinned to 5,000 triangles.
- meshmonk: viscoelastic registration, source onto target from the rigid alignment; both thinned to 20,000 triangles.
- coded: 3D-CODED, trained by `meshmatch.experiments.coded` without constraints (``--coded``), its code searched
  by the Chamfer distance.
- transmatch: a transformer trained by `meshmatch.experiments.transmatch` (``--transmatch``), not refined.
- ours: this project, refined and not.

zoomout and meshmonk need `pip install 'meshmatch[bench]'`, and so does nricp. Each cell, a rival on a set, is one JSON
file in the output folder; a second run measures only what is not there. ``--minutes`` starts no further cell after that
time. The table says how many pairs were measured, and how long learned methods were trained.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.console import Console

from meshmatch.errors import OptionError
from meshmatch.experiments.adapters import CodedMatcher, MeshmonkMatcher, NricpMatcher, RigidMatcher
from meshmatch.experiments.bench import PipelineMatcher, chosen_pairs
from meshmatch.experiments.protocols import CLOUD_SET, SET_NAMES, load_set
from meshmatch.experiments.report import circumstances, status_of
from meshmatch.experiments.rival_cells import Cells, Rival, draw_cells, measured, print_cells
from meshmatch.experiments.spectral import ZoomOutMatcher
from meshmatch.maps.geodesics import GEODESIC
from meshmatch.outputs import make_folder
from meshmatch.threads import set_threads

NAMES = ("rigid", "zoomout", "nricp", "meshmonk", "coded", "transmatch", "ours")
_INSTALL = "pip install 'meshmatch[bench]'"


def find_rivals(options: argparse.Namespace) -> list[Rival]:
    """The rivals that were asked for, those that cannot run among them.

    Raises
    ------
    OptionError
        There is no such rival.
    ModelError, TemplateError
        A model that was given cannot be read.
    """
    found: list[Rival] = []
    for name in dict.fromkeys(options.rivals.split(",")):
        if name not in NAMES:
            raise OptionError(f"there is no rival {name!r}", f"choose from {', '.join(NAMES)}")
        found += _MAKERS[name](options)
    return found


def _needs(package: str, rival: Rival) -> list[Rival]:
    if find_spec(package) is not None:
        return [rival]
    return [Rival(rival.name, rival.label, None, f"{package} is not installed: {_INSTALL}")]


def _coded(options: argparse.Namespace) -> list[Rival]:
    if options.coded is None:
        how = "give --coded MODEL, made by python -m meshmatch.experiments.coded"
        return [Rival("coded", "3D-CODED", None, how)]
    minutes, model = _card(options.coded)
    matcher = CodedMatcher(str(options.coded), options.coded_steps, options.seed)
    return [Rival("coded", "3D-CODED", matcher, "", minutes, model)]


def _transmatch(options: argparse.Namespace) -> list[Rival]:
    if options.transmatch is None:
        how = "give --transmatch MODEL, made by python -m meshmatch.experiments.transmatch"
        return [Rival("transmatch", "TransMatch", None, how)]
    from meshmatch.experiments.transformer import TransMatcher, load_transmatch

    words = load_transmatch(options.transmatch).words
    matcher = TransMatcher(str(options.transmatch), seed=options.seed)
    model = f"{words.get('date')} step {words.get('steps')}"
    return [Rival("transmatch", "TransMatch", matcher, "", float(words.get("minutes", 0.0)), model)]


def _ours(options: argparse.Namespace) -> list[Rival]:
    minutes, model = _card(options.model)
    refined, plain = (PipelineMatcher(options.model, how, options.seed) for how in ("nodes", "none"))
    return [
        Rival("ours-none", "ours, unrefined", plain, "", minutes, model),
        Rival("ours", "ours, refined", refined, "", minutes, model),
    ]


def _card(name: str | Path) -> tuple[float, str]:
    from meshmatch.models.registry import find_model

    card = find_model(name)[1]
    return card.training_minutes, card.weights_sha256


_MAKERS: dict[str, Callable[[argparse.Namespace], list[Rival]]] = {
    "rigid": lambda given: [Rival("rigid", "rigid, nearest", RigidMatcher(given.seed))],
    "zoomout": lambda given: _needs("pyFM", Rival("zoomout", "ZoomOut (pyfmaps)", ZoomOutMatcher())),
    "nricp": lambda given: _needs(
        "trimesh", Rival("nricp", "nricp (trimesh)", NricpMatcher(seed=given.seed))
    ),
    "meshmonk": lambda given: _needs(
        "meshmonk", Rival("meshmonk", "meshmonk", MeshmonkMatcher(seed=given.seed))
    ),
    "coded": _coded,
    "transmatch": _transmatch,
    "ours": _ours,
}


def run(options: argparse.Namespace, console: Console) -> dict[str, Any]:
    """Everything that `main` does, errors as exceptions; the JSON line's record is returned too."""
    set_threads(options.threads)
    until = time.monotonic() + 60 * options.minutes
    benches = [load_set(name, options.data) for name in options.sets.split(",")]
    rivals = find_rivals(options)
    make_folder(options.output)
    cells: Cells = {bench.name: {} for bench in benches}
    for rival in rivals:
        for bench in benches:
            found = None
            if rival.matcher is not None:
                console.print(f"{rival.label} on {bench.name}", highlight=False)
                found = measured(
                    rival,
                    bench,
                    chosen_pairs(bench, options.limit_pairs),
                    options.output,
                    jobs=options.jobs,
                    threads=options.threads,
                    cache=options.cache,
                    late=time.monotonic() > until,
                    console=console,
                )
            late = f"the time was up ({options.minutes:g} min): run again to go on"
            cells[bench.name][rival.name] = found or {"skipped": rival.missing or late}
    print_cells(cells, rivals)
    if any("scores" in found for row in cells.values() for found in row.values()):
        picture = options.picture or options.output / "rivals.png"
        draw_cells(cells, rivals, picture)
        console.print(f"wrote {picture}", highlight=False)
    record = {
        "benchmark": "rivals, development half",
        **circumstances(options.threads, options.jobs),
        "geodesic": GEODESIC,
        "seed": options.seed,
        "limit_pairs": options.limit_pairs,
        "sets": cells,
    }
    print(json.dumps(record), flush=True)
    return record


def options_of(words: Sequence[str] | None) -> argparse.Namespace:
    """What was asked for."""
    parser = argparse.ArgumentParser(
        "python -m meshmatch.experiments.rivals",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/bench"), help="the benchmark's data")
    parser.add_argument("--sets", default=",".join(SET_NAMES), help=f"some of %(default)s, {CLOUD_SET}")
    parser.add_argument("--rivals", default=",".join(NAMES), help="some of %(default)s")
    parser.add_argument("--limit-pairs", type=int, metavar="N", help="N pairs of each set, evenly spread")
    parser.add_argument("--minutes", type=float, default=1e6, help="start no further cell after so long")
    parser.add_argument(
        "--output", type=Path, default=Path("out/rivals"), help="folder of the cells: %(default)s"
    )
    parser.add_argument("--picture", type=Path, help="the plot, by default rivals.png among the cells")
    parser.add_argument("--model", default="human", help="ours: %(default)s")
    parser.add_argument("--coded", metavar="MODEL", help="a model with a pointwise decoder")
    parser.add_argument("--coded-steps", type=int, default=2000, help="of its search over codes: %(default)s")
    parser.add_argument("--transmatch", type=Path, metavar="MODEL", help="a folder of experiments.transmatch")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--threads", type=int, default=1, help="threads in each process")
    parser.add_argument("--cache", type=Path, help="folder of kept geodesic distances")
    options = parser.parse_args(words)
    if min(options.jobs, options.threads, options.coded_steps) < 1 or options.seed < 0:
        parser.error("jobs, threads and steps of 1 or more and a seed of 0 or more are needed")
    return options


def main(words: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 when it ran, 1 when the data or the choice stopped it."""
    options = options_of(words)
    return status_of(lambda: run(options, Console(stderr=True)))


if __name__ == "__main__":
    sys.exit(main())
