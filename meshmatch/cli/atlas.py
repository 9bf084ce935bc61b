"""``meshmatch atlas``."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from typer import Argument, Option

from meshmatch.cli import options
from meshmatch.cli.options import check_outputs, grouped, output_option
from meshmatch.cli.words import Console, print_json
from meshmatch.errors import OptionError
from meshmatch.outputs import folder_on_success
from meshmatch.threads import thread_limit

if TYPE_CHECKING:
    from meshmatch.collections.atlas_files import Findings
    from meshmatch.collections.registered import Registered

_ODD = 3.0  # sizes further apart than this are probably units


@dataclass(frozen=True)
class AtlasOptions:
    """What an atlas is, and what is found out about it."""

    modes: int = Option(100, min=1, metavar="N", help="Maximum number of modes to keep.")
    scale: Literal["keep", "remove"] = Option("keep", help="Keep the shapes' sizes, or scale all shapes to one size.")
    robust: bool = Option(False, "--robust", help="Reduce the influence of outliers among the shapes.")
    poor: bool = Option(False, "--poor", help="Include shapes whose fit is poor.")
    groups: tuple[Path, Path] | None = Option(
        None, metavar="A.txt B.txt", help="Compare two groups: files with the names of their shapes, one per line."
    )
    statistic: Literal["normal", "hotelling"] = Option(
        "normal",
        help="Compare displacements along the normal of the mean, or in all directions (Hotelling's T squared).",
    )
    permutations: int = Option(10_000, min=1, metavar="N", help="Maximum number of permutations of the group labels.")
    samples: int = Option(0, min=0, max=10_000, metavar="N", help="Number of random shapes to write.")
    measures: bool = Option(
        True,
        "--measures/--no-measures",
        help="Measure compactness, generalisation and specificity, which takes a while.",
    )
    seed: options.Seed = 0

    def check(self) -> None:
        """Refuse a choice that nothing obeys (`OptionError`)."""
        if self.groups is None and self.statistic != "normal":
            raise OptionError("--statistic compares groups, and there are none", "add --groups A.txt B.txt")


@grouped
def atlas(
    *,
    fits: str = Argument(
        ...,
        metavar="FITS",
        help="A folder that `meshmatch fit` made, or its URL; or a folder of meshes that share their vertices and faces.",
    ),
    output: Path = output_option("ATLAS", "A new folder for the atlas."),
    how: AtlasOptions,
    threads: options.Threads = 2,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Learn the mean shape of a collection and the modes in which its shapes vary.

    Writes arrays, tables, pictures, the modes as morph targets, and page.html with a slider for each mode. With
    --groups, also tests where two groups differ (permutation test, corrected for multiple comparisons).
    """
    from meshmatch.collections.atlas_files import record, write_folder

    how.check()
    check_outputs([Path(fits), *(how.groups or ())], output)
    console = Console(quiet)
    with folder_on_success(output) as folder, _shapes(fits, how.poor) as shapes, thread_limit(threads):
        for name, verdict in shapes.left_out.items():
            console.warn(f"{name}: left out, for its fit is {verdict}")
        made = shapes.atlas(modes=how.modes, scale=how.scale, robust=how.robust)
        _warn(console, made, how)
        found = _find(console, made, shapes, how)
        names = write_folder(folder, made, found, rotation=shapes.rotation, title=output.name)
    about = record(made, found)
    _tell(console, about)
    console.say(f"wrote {output}: {', '.join(names)}")
    if json:
        print_json({"output": output, "left_out": shapes.left_out, "files": names} | about)


def _shapes(fits: str, poor: bool) -> AbstractContextManager["Registered"]:
    """The shapes of a folder, whichever kind it is."""
    from meshmatch.collections.collection import Collection
    from meshmatch.collections.registered import registered_meshes
    from meshmatch.collections.settle import read_about

    collection = Collection(fits)
    if not collection.store.remote and read_about(collection.store) is None:
        if not Path(fits).is_dir():
            raise OptionError(f"{fits} is not a folder", "give the folder that `meshmatch fit` made")
        return registered_meshes(fits)
    return collection.registered(poor)


def _warn(console: Console, made: Any, how: AtlasOptions) -> None:
    from meshmatch.collections.registered import size_ratio

    times = size_ratio(made.sizes)
    if how.scale == "keep" and times > _ODD:
        console.warn(f"the largest shape is {times:.3g} times as large as the smallest: do the files have one unit?")


def _find(console: Console, made: Any, shapes: "Registered", how: AtlasOptions) -> "Findings":
    from meshmatch.collections.atlas_files import Findings
    from meshmatch.collections.measures import measure_atlas
    from meshmatch.collections.registered import read_group

    comparison, names = None, ("A", "B")
    if how.groups is not None:  # first: a wrong name is told before the long work
        first, second = (read_group(path, shapes) for path in how.groups)
        names = how.groups[0].stem, how.groups[1].stem
        comparison = made.compare(
            first, second, kind=how.statistic, permutations=how.permutations, seed=how.seed
        )  # fmt: skip
    measures = None
    if how.measures and len(shapes.names) > 3:
        with console.progress() as progress:
            measures = measure_atlas(made, shapes.points, seed=how.seed, progress=progress)
    return Findings(measures, comparison, names, how.samples, how.seed)


def _tell(console: Console, about: dict[str, Any]) -> None:
    shares = about["compactness"]
    few = ", ".join(f"{100 * share:.1f} %" for share in shares[:3])
    console.say(f"{about['shapes']} shapes, {about['modes']} modes; the first explain {few} of the variance")
    name, apart = next(iter(about["furthest"].items()))
    console.say(f"furthest from the mean: {name}, by {apart:.4g}")
    if "measures" in about:
        found = about["measures"]
        told = (
            f"{kind} {found[kind][-1]:.4g} ({found[f'{kind}_surface'][-1]:.4g} between surfaces)" for kind in _KINDS
        )
        console.say(f"with {found['counts'][-1]} modes: {', '.join(told)}")
    if "groups" in about:
        found = about["groups"]
        first, second = found["names"]
        console.say(
            f"{first} and {second} ({found['counts'][0]} and {found['counts'][1]} shapes): p = {found['p_overall']:.4g} "
            f"overall; {found['vertices_corrected']} of {about['vertices']} vertices differ at "
            f"a family-wise error of {found['level']:g}, "
            f"{found['vertices_fdr']} at a false discovery rate of {found['level']:g}"
        )


_KINDS = "generalisation", "specificity"
