"""``meshmatch picture`` and ``meshmatch view``: pictures of shapes, maps and values, and the interactive page of a map."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from typer import Argument, Option

import meshmatch
from meshmatch.cli import options, user_messages
from meshmatch.cli.transfer_options import Transfer, ViewMapOptions
from meshmatch.cli.user_messages import Console, print_json
from meshmatch.errors import ModelError, OptionError, warn
from meshmatch.models.registry import TEMPLATE, locate_model

if TYPE_CHECKING:
    from meshmatch.render.compose import Composition
    from meshmatch.render.picture import Look
    from meshmatch.shapes.appearance import Appearance
    from meshmatch.templates.template import Template

Subject: TypeAlias = "tuple[meshmatch.Shape | Template, Appearance | None]"
"""A shape or template to draw, with its textures or colors if it has any."""


@dataclass(frozen=True)
class PictureOptions:
    """Options that select what is drawn."""

    map: Path | None = options.optional(
        "MAP",
        "Draw corresponding points of two shapes, SOURCE TARGET, in the same color, by this map from the first to the "
        "second, or by a folder of `meshmatch fit` with the fits of both.",
    )
    confidence: bool = Option(
        False, "--confidence", help="With --map: draw the confidence of the map with a color scale."
    )
    truth: options.Truth = None
    points: options.Points = None
    unit: options.ErrorUnit = "auto"
    values: list[Path] | None = options.optional(
        "FILE",
        "Draw one number per vertex (.npy or .csv) with a color scale, or three as a color. Give it once for each shape.",
    )
    title: str | None = options.optional("TEXT", "Title of the color scale: the quantity of --values, with its unit.")
    range: tuple[float, float] | None = options.optional(
        "LOW HIGH", "Ends of the color scale. Default: chosen from the values."
    )
    labels: list[Path] | None = options.optional(
        "FILE", "Draw a label per vertex or face (.npy, .csv, .txt or .json). Give it once for each shape."
    )
    on: Literal["vertices", "faces"] | None = Option(
        None, help="Whether --labels belong to vertices or faces. Default: decided by their number."
    )
    fit: str | None = options.optional(
        "MESH|MODEL",
        "For one shape: the output of `meshmatch register`, or a model to fit now. The template is drawn over the "
        "shape, colored by distance.",
    )
    image: Path | None = options.optional("FILE", "Texture image for a shape, instead of the one its file names.")
    plain: bool = Option(False, "--plain", help="Draw no textures, colors or nodes.")
    seed: options.Seed = 0

    @property
    def files(self) -> list[Path | None]:
        """All input files other than the shapes."""
        lists = [*(self.values or []), *(self.labels or []), *(self.points or ())]
        return [self.map, self.image, self.truth, None if self.fit is None else Path(self.fit), *lists]

    def check(self, count: int) -> None:
        """Raise `OptionError` if options contradict each other, or the number of shapes."""
        known = options.check_truth(self.truth, self.points)
        each = {"--values": self.values, "--labels": self.labels}
        single = {"--fit": self.fit, "--image": self.image}
        modes = {"--map": self.map, **each, **single, "--plain": self.plain}
        chosen = [name for name, given in modes.items() if given]
        if len(chosen) > 1:
            raise OptionError(f"{' and '.join(chosen)} do not go together", "make a picture for each")
        if self.map is not None and count != 2:
            raise OptionError(f"a map is of two shapes, not of {count}", "name the source, then the target")
        if self.map is None and (self.confidence or known):
            what = "--confidence needs" if self.confidence else "--truth and --points need"
            raise OptionError(f"{what} a map", "add --map")
        if self.confidence and known:
            raise OptionError("--confidence and the truth both color the shapes", "make a picture for each")
        for name, files in each.items():
            if files and len(files) != count:
                shapes = "1 shape needs" if count == 1 else f"{count} shapes need"
                problem = f"{shapes} {name} {'once' if count == 1 else f'{count} times'}, not {len(files)}"
                raise OptionError(problem, "give one for each shape, in the same order")
        for name, given in single.items():
            if given is not None and count != 1:
                raise OptionError(f"{name} is for one shape, not for {count}", "draw the shapes one by one")
        if self.on is not None and not self.labels:
            raise OptionError("--on needs --labels", "give the labels, or leave out --on")
        if self.title is not None and not self.values:
            raise OptionError("--title needs --values", "give the values, or leave out --title")
        if self.range is not None and not (self.values or self.fit or known):
            raise OptionError("--range needs a color scale", "it goes with --values, --truth, --points and --fit")


@dataclass(frozen=True)
class LookOptions:
    """Options of the view and the canvas."""

    view: Literal["quarter", "front", "left", "right", "back", "above"] = Option("quarter", help="Direction of view.")
    up: options.Axis | None = Option(None, help="Axis that points up in the files. Default: detected.")
    front: options.Axis | None = Option(None, help="Axis that the shapes face in the files. Default: detected.")
    size: str | None = options.optional("WxH", "Width and height in pixels, such as 1200x800. Default: chosen to fit.")
    background: str = Option(
        "white", metavar="COLOR", help="Background: white, dark, transparent, or a color such as #e8f0f8."
    )
    ground: bool = Option(True, "--ground/--no-ground", help="Draw shadows.")

    def look(self) -> "Look":
        """The look for the library."""
        from meshmatch.render.picture import VIEWS, Look

        options.check_axes(self.up, self.front)
        size = None
        if self.size is not None:
            found = re.fullmatch("([0-9]+)x([0-9]+)", self.size.lower())
            if found is None:
                raise OptionError(f"invalid size '{self.size}'", "give width and height in pixels, such as 1200x800")
            if max(map(len, found.groups())) > 9:
                raise OptionError(f"a picture of {self.size} pixels is too large", "give a size such as 1200x800")
            size = int(found[1]), int(found[2])
        return Look(size, self.background, self.up, self.front, *VIEWS[self.view], self.ground)


@options.grouped
def picture(
    *,
    shapes: list[Path] = Argument(
        ...,
        metavar="SHAPE...",
        help="Shapes to draw side by side. A template, given as a file or by the name of a template or model, is drawn with "
        "its nodes.",
    ),
    output: Path = options.output_option("PNG", "The picture."),
    shown: PictureOptions,
    how: LookOptions,
    name: list[str] | None = options.optional(
        "TEXT", "Caption of a shape; give it once for each shape. Default: the file's name."
    ),
    names: bool = Option(True, "--names/--no-names", help="Draw the captions."),
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Draw shapes, maps and values on shapes.

    Writes a PNG; no GPU, display or OpenGL is needed. Shapes with textures or colors are drawn with them, unless an option
    selects something else.
    """
    shown.check(len(shapes))
    if name and len(name) != len(shapes):
        problem = f"{len(shapes)} shapes need {len(shapes)} names, not {len(name)}"
        raise OptionError(problem, "give --name once for each shape")
    look = how.look()
    options.check_outputs([*shapes, *shown.files], picture=output)
    console = Console(quiet)
    subjects = [_load_subject(path, shown) for path in shapes]
    made = _compose(shown, subjects, look, console)
    labels = [panel.label for panel in made.panels]
    own = [subject.name for subject, _ in subjects]
    for k, (before, given) in enumerate(zip(own, name or user_messages.names_of(shapes, own), strict=True)):
        if name or given != before:
            labels[k] = labels[k].replace(before, given) if len(labels) > len(shapes) else given
    width, height = meshmatch.picture(made, output, look=look, names=labels if names else [""] * len(labels))
    console.say(f"drew {output}: {made.caption} ({width} x {height} pixels)")
    if json:
        record = {"output": output, "shapes": [str(path) for path in shapes], "shows": made.caption}
        print_json(record | {"width": width, "height": height} | made.record)


def _load_subject(path: Path, shown: PictureOptions) -> Subject:
    """Load a shape, or a template by its file, its name or the name of a model."""
    from meshmatch.api.pictures import read_look

    if (template := _template(path)) is not None:
        return template, None
    shape = meshmatch.load_shape(path)
    if shown.plain or shown.map or shown.values or shown.labels or shown.fit:
        return shape, None
    look, _, note = read_look(path, shape, shown.image)
    if note:
        warn(f"{shape.name} is {note}")
    return shape, look


def _template(path: Path) -> "Template | None":
    from meshmatch.templates.location import bundled_folder
    from meshmatch.templates.template import load_template

    if path.suffix.lower() == ".safetensors":
        return load_template(path)
    if path.is_file() or path.suffix:
        return None
    bundle = bundled_folder() / "human" / f"{path.name}.safetensors"
    if len(path.parts) == 1 and bundle.is_file():
        return load_template(bundle)
    try:
        return load_template(locate_model(str(path)) / TEMPLATE)
    except ModelError:
        return None  # then reported as a missing shape


def _compose(shown: PictureOptions, subjects: list[Subject], look: "Look", console: Console) -> "Composition":
    """Read the files that the options name, and compose the picture."""
    from meshmatch.api.pictures import composed
    from meshmatch.render.compose import compose_shapes

    shapes: list[Any] = [getattr(each, "shape", each) for each, _ in subjects]  # the shapes of templates
    if shown.map is not None:
        return _compose_map(shown, shown.map, shapes, look)
    if shown.fit is not None:
        return _compose_fit(shown, shown.fit, shapes[0], look, console)
    if shown.values:
        from meshmatch.transfer.value_files import load_values

        tables = [load_values(*pair).numbers for pair in zip(shown.values, shapes, strict=True)]
        colors = all(table.ndim == 2 and table.shape[1] > 1 for table in tables)
        title = shown.title or ("" if colors else shown.values[0].stem)
        return composed(shapes, look, values=tables, title=title, limits=shown.range)
    if shown.labels:
        from meshmatch.transfer.label_files import load_labels

        labels = [load_labels(*pair, shown.on) for pair in zip(shown.labels, shapes, strict=True)]
        return composed(shapes, look, labels=labels)
    return compose_shapes(subjects, plain=shown.plain)


def _compose_map(shown: PictureOptions, file: Path, shapes: "list[meshmatch.Shape]", look: "Look") -> "Composition":
    from meshmatch.render.compose import compose_confidence, compose_errors, compose_match

    source, target = shapes
    if file.is_dir():
        found = meshmatch.Collection(file).maps_between(source, target).forward
    else:
        found = meshmatch.load_map(file, source, target)
    if shown.confidence:
        return compose_confidence(source, target, found, look)
    known = options.load_truth(shown.truth, shown.points, (source, target))
    if known is None:
        return compose_match(source, target, found, look=look)
    from meshmatch.api.kinds import error_unit
    from meshmatch.maps.evaluate import map_errors
    from meshmatch.maps.geodesics import GeodesicDistances

    errors = map_errors(found.index, *known, GeodesicDistances(target))
    return compose_errors(source, target, found, known, errors, error_unit(shown.unit, target), shown.range, look)


def _compose_fit(
    shown: PictureOptions, fit: str, shape: "meshmatch.Shape", look: "Look", console: Console
) -> "Composition":
    """Compose a fitted template over a shape: read from a file, or fitted now by a model."""
    from meshmatch.render.compose import compose_fit
    from meshmatch.shapes.files import SUFFIXES
    from meshmatch.shapes.input_files import suffix_of

    file = Path(fit)
    if file.is_file() or suffix_of(file) in SUFFIXES:
        return compose_fit(shape, meshmatch.load_shape(file), limits=shown.range)
    locate_model(fit)
    config = meshmatch.FitConfig(seed=shown.seed, up=look.up, front=look.front)
    with console.progress() as report:
        found = meshmatch.register(shape, model=fit, config=config, progress=report)
    console.say(f"fitted the template of {fit} to {shape.name}: {user_messages.describe_fit(found)}")
    fitted = meshmatch.Shape(found.points_in_file, found.faces, f"{fit} on {shape.name}")
    return compose_fit(shape, fitted, found.frame.turn, shown.range)


@options.grouped
def view(
    *,
    source: options.Source,
    target: options.Target,
    output: Path = options.output_option("PAGE", "The page: one .html file."),
    maps: ViewMapOptions,
    run: options.RunOptions,
) -> None:
    """Write an interactive page of two shapes and a map.

    Corresponding points have the same color; point at one shape to see the corresponding point on the other. The page is
    a single file for any recent browser and needs no network. With --map, --up and --front set the orientation of SOURCE
    on the page.
    """
    from meshmatch.render.viewer.assembly import check_page

    check_page(output)
    transfer = Transfer(source, target, output, maps, run)
    with transfer.outputs() as (temporary,):
        page = meshmatch.view(source, target, temporary, transfer, up=maps.up, front=maps.front, names=transfer.names)
    transfer.console.say(*page.notes)
    transfer.console.say(f"wrote {output} ({page.size / 1e6:.1f} MB): open it in a browser")
    record = {"drawn_vertices": list(page.drawn), "bytes": page.size}
    if run.json:
        print_json(transfer.record(record, page.maps, float(page.maps.forward.confidence.mean())))
