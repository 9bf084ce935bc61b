"""``meshmatch atlas``."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from typer import Argument, Option

from meshmatch.cli import options
from meshmatch.cli.options import check_outputs, grouped, output_option
from meshmatch.cli.user_messages import Console, print_json, print_rows
from meshmatch.collections.formula import parse
from meshmatch.errors import OptionError
from meshmatch.outputs import folder_on_success
from meshmatch.threads import thread_limit

if TYPE_CHECKING:
    from meshmatch.collections.atlas_files import AtlasResults
    from meshmatch.collections.registered import Registered


@dataclass(frozen=True)
class AtlasOptions:
    """Options of the atlas, and of the analyses of it."""

    modes: int = Option(100, min=1, metavar="N", help="Maximum number of modes to keep.")
    space: Literal["form", "shape", "keep", "remove"] | None = Option(
        None,
        "--space",
        "--scale",
        help="form (or keep): shapes with their sizes (default); shape (or remove): all shapes scaled to the same size.",
    )
    robust: bool = Option(False, "--robust", help="Reduce the influence of outliers among the shapes.")
    align_by: str = Option(
        "whole",
        metavar="PART",
        help="Superimpose shapes with several parts by this part, so that the atlas has the pose of the others: its number "
        "(1 is the largest), or its name in the template or in the files. whole: by all vertices. each: superimpose every "
        "connected part on its own, which removes their relative pose.",
    )
    poor: bool = Option(False, "--poor", help="Include shapes whose fit is poor.")
    leave_out: list[str] | None = Option(
        None,
        metavar="NAME",
        help="Leave out this shape, for example a cut one; * and ? are wildcards. May be repeated.",
    )
    groups: tuple[Path, Path] | None = Option(
        None,
        metavar="A.txt B.txt",
        help="Compare two groups, given as files with the names of their shapes, one per line.",
    )
    statistic: Literal["normal", "hotelling"] = Option(
        "normal",
        help="Compare displacements along the normal of the mean, or in all directions (Hotelling's T squared).",
    )
    metadata: Path | None = Option(
        None,
        metavar="TABLE",
        help="Covariates of the shapes: a table with a row per shape, by name; .csv, .tsv or .txt.",
    )
    model: str | None = Option(
        None,
        metavar="FORMULA",
        help="Explain the shapes by columns of --metadata (Procrustes analysis of variance): 'shape ~ log(size) + sex * "
        "age', or 'form ~ ...' for shapes with their sizes. size is that of scores.csv if the table has no such column.",
    )
    blocks: str | None = Option(
        None,
        metavar="COLUMN",
        help="Permute only among shapes with the same value in this column, such as the individual of paired or repeated "
        "measurements.",
    )
    symmetry: bool = Option(
        False,
        "--symmetry",
        help="Analyse asymmetry: compare each shape, such as a head, with its mirror image, or with --sides the left with "
        "the right shapes.",
    )
    individuals: str | None = Option(
        None,
        metavar="COLUMN",
        help="With --symmetry: the individual of each shape. If individuals were measured several times, the measurement "
        "error is reported too.",
    )
    sides: str | None = Option(
        None, metavar="COLUMN", help="With --symmetry: the side of each shape, such as left or right."
    )
    permutations: int = Option(10_000, min=1, metavar="N", help="Maximum number of permutations in tests.")
    samples: int = Option(0, min=0, max=10_000, metavar="N", help="Number of random shapes to write.")
    measures: bool = Option(
        True,
        "--measures/--no-measures",
        help="Measure compactness, generalisation and specificity, which takes a while.",
    )
    format: Literal["png", "svg", "pdf"] = Option("png", help="Format of the charts, which need matplotlib.")
    seed: options.Seed = 0

    def check(self) -> None:
        """Raise `OptionError` for options that have no effect or contradict each other."""
        if self.groups is None and self.model is None and not self.symmetry and self.statistic != "normal":
            hint = "add --groups A.txt B.txt, --model or --symmetry"
            raise OptionError("--statistic is for groups, models and symmetry, and there are none", hint)
        if self.symmetry and self.sides is None and self.align_by != "whole":
            raise OptionError("--symmetry is of whole shapes", "leave out --align-by")
        if self.format != "png":
            from meshmatch.render.charts import check_chart

            check_chart(f"charts.{self.format}")
        for option, given in {"--individuals": self.individuals, "--sides": self.sides}.items():
            if given is not None and not self.symmetry:
                raise OptionError(f"{option} is for symmetry", "add --symmetry")
            if given is not None and self.metadata is None:
                raise OptionError(f"{option} is a column of a table, and there is none", "add --metadata TABLE")
        if self.sides is not None and self.individuals is None:
            raise OptionError("--sides are of individuals", "add --individuals COLUMN")
        table = self.metadata is not None and self.individuals is None
        for option, idle in {"--metadata": table, "--blocks": self.blocks is not None}.items():
            if idle and self.model is None:
                raise OptionError(f"{option} is for a model, and there is none", "add --model 'shape ~ ...'")
        if self.model is not None and self.space is not None:
            space = {"keep": "form", "remove": "shape"}.get(self.space, self.space)
            if parse(self.model).space != space:
                hint = f"write '{space} ~ ...', or leave out --space"
                raise OptionError(f"the formula is not of {space}, which --space asks for", hint)

    @property
    def scale(self) -> Literal["keep", "remove"]:
        """Whether sizes are kept or removed, by the model's formula if there is one, else by --space."""
        space = self.space if self.model is None else parse(self.model).space
        return "remove" if space in ("shape", "remove") else "keep"


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
    """Learn the mean and the modes of a collection.

    Writes arrays, tables, pictures, the modes as morph targets, and page.html with a slider for each of the first
    modes. With --groups, also tests where two groups differ (permutation test, corrected for multiple comparisons). With
    --model, also computes how much of the variation the terms of a linear model explain, and where.
    """
    from meshmatch.collections.atlas_files import atlas_record, write_folder
    from meshmatch.collections.model_files import anova_rows

    how.check()
    check_outputs([Path(fits), *(how.groups or ()), *([how.metadata] if how.metadata else [])], output)
    console = Console(quiet)
    with folder_on_success(output) as folder, _shapes(fits, how) as shapes, thread_limit(threads):
        for name in (name for name, why in shapes.left_out.items() if why == "poor"):
            console.warn(f"{name}: left out, as its fit is poor")
        made = shapes.atlas(modes=how.modes, scale=how.scale, robust=how.robust, align_by=how.align_by)
        _warn(console, made, how)
        found = _find(console, made, shapes, how)
        names = write_folder(folder, made, found, rotation=shapes.rotation, title=output.name)
    about = atlas_record(made, found)
    _report(console, about)
    for table in ("model", "asymmetry"):
        if table in about and not json and not quiet:
            print_rows(anova_rows(about[table]))
    console.say(f"wrote {output}: {', '.join(names)}")
    if json:
        print_json({"output": output, "left_out": shapes.left_out, "cut": shapes.cut, "files": names} | about)


def _shapes(fits: str, how: AtlasOptions) -> AbstractContextManager["Registered"]:
    """Open the registered shapes of a folder of fits or meshes."""
    from meshmatch.collections.collection import Collection
    from meshmatch.collections.registered import registered_meshes
    from meshmatch.collections.select_setting import read_manifest

    collection = Collection(fits)
    if not collection.store.remote and read_manifest(collection.store) is None:
        if not Path(fits).is_dir():
            raise OptionError(
                f"{fits} is not a folder", "give the folder that `meshmatch fit` made, or one of registered meshes"
            )
        return registered_meshes(fits, how.leave_out or ())
    return collection.registered(how.poor, how.leave_out or ())


def _warn(console: Console, made: Any, how: AtlasOptions) -> None:
    from meshmatch.collections.covariates import shorten_names
    from meshmatch.collections.registered import find_outliers, mixed_units

    units = mixed_units(made.names, made.sizes)
    if how.scale == "keep" and units:
        console.warn(units)
    elif len(rows := find_outliers(made.distances)) and not how.robust:
        share = sum(made.scores[rows, 0] ** 2) / sum(made.scores[:, 0] ** 2)
        console.warn(
            f"{shorten_names([made.names[k] for k in rows])}: unlike the others, and {100 * share:.0f} % of mode 1. "
            "Leave out shapes that are cut, broken, mirrored or of another kind (--leave-out), or try --robust"
        )


def _find(console: Console, made: Any, shapes: "Registered", how: AtlasOptions) -> "AtlasResults":
    from meshmatch.collections.asymmetry import measure_asymmetry
    from meshmatch.collections.atlas_files import AtlasResults
    from meshmatch.collections.measures import measure_atlas
    from meshmatch.collections.registered import read_group

    comparison, names = None, ("A", "B")
    members: dict[str, str] = {}
    if how.groups is not None:  # first, so that a wrong name is reported before the long computation
        first, second = (read_group(path, shapes) for path in how.groups)
        names = how.groups[0].stem, how.groups[1].stem
        members = dict.fromkeys(first, names[0]) | dict.fromkeys(second, names[1])
        comparison = made.compare(
            first, second, kind=how.statistic, permutations=how.permutations, seed=how.seed
        )  # fmt: skip
    explained = None
    if how.model is not None:
        explained = made.anova(
            how.model, how.metadata, blocks=how.blocks, kind=how.statistic, permutations=how.permutations, seed=how.seed
        )
        for name, column in explained.left_out.items():
            console.warn(f"{name}: left out of the model, as its {column} is missing")
    asymmetry = None
    if how.symmetry:
        asymmetry = measure_asymmetry(
            made, how.metadata, individuals=how.individuals, sides=how.sides,
            kind=how.statistic, permutations=how.permutations, seed=how.seed,
        )  # fmt: skip
    measures = None
    if how.measures and len(shapes.names) > 3:
        with console.progress() as progress:
            measures = measure_atlas(made, shapes.points, seed=how.seed, progress=progress)
    return AtlasResults(
        measures, comparison, names, explained, how.samples, how.seed, how.format, members, asymmetry, how.align_by
    )  # fmt: skip


def _report(console: Console, about: dict[str, Any]) -> None:
    shares = about["compactness"]
    first_shares = ", ".join(f"{100 * share:.1f} %" for share in shares[:3])
    console.say(f"{about['shapes']} shapes, {about['modes']} modes; the first explain {first_shares} of the variance")
    name, apart = next(iter(about["furthest"].items()))
    console.say(f"furthest from the mean: {name}, by {apart:.4g} (root mean square over its surface)")
    if "measures" in about:
        found = about["measures"]
        values = (
            f"{kind} {found[kind][-1]:.4g} ({found[f'{kind}_surface'][-1]:.4g} between surfaces)" for kind in _KINDS
        )
        console.say(f"with {found['counts'][-1]} modes: {', '.join(values)}")
    if "groups" in about:
        found = about["groups"]
        first, second = found["names"]
        console.say(
            f"{first} and {second} ({found['counts'][0]} and {found['counts'][1]} shapes): p = {found['p_overall']:.4g} "
            f"overall, {found['p_anywhere']:.4g} anywhere (largest statistic); "
            f"{found['vertices_corrected']} of {about['vertices']} vertices differ at "
            f"a family-wise error of {found['level']:g}, "
            f"{found['vertices_fdr']} at a false discovery rate of {found['level']:g}"
        )
    if "model" in about:
        found = about["model"]
        for column, taken in found["columns"].items():
            console.say(f"{column}: {taken}")
        blocks = f" within {found['blocks']}" if found["blocks"] else ""
        every = "all " if found["exact"] else ""
        console.say(
            f"{found['formula']}, {found['shapes']} shapes, sequential sums of squares, {every}{found['permutations']:,} "
            f"permutations{blocks} of residuals"
        )
    if "asymmetry" in about:
        found = about["asymmetry"]
        what = "the sides differ by" if found["matching"] else "the mean differs from its mirror image by"
        console.say(f"{what} {found['of_mean']:.4g} on average; asymmetry.csv lists each individual")


_KINDS = "generalisation", "specificity"
