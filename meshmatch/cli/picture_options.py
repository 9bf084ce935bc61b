"""The options of ``meshmatch picture`` and the files they name."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from meshmatch.cli.console import Console
from meshmatch.cli.options import Axis, Seed, check_axes
from meshmatch.cli.truth import Points, Truth, check_truth, load_truth
from meshmatch.cli.words import fit_words
from meshmatch.errors import OptionError

if TYPE_CHECKING:
    from meshmatch.render.compose import Composition
    from meshmatch.render.picture import Look
    from meshmatch.shapes.appearance import Appearance
    from meshmatch.shapes.shape import Shape
    from meshmatch.templates.template import Template

View = Literal["quarter", "front", "left", "right", "back", "above"]


@dataclass(frozen=True)
class PictureOptions:
    """What is shown."""

    map: Annotated[
        Path | None,
        typer.Option(metavar="MAP", help="Of two shapes, SOURCE TARGET, a map: matched places in one colour."),
    ] = None
    confidence: Annotated[bool, typer.Option("--confidence", help="With --map: its confidence, as a color map.")] = (
        False
    )
    truth: Truth = None
    points: Points = None
    unit: Annotated[
        Literal["cm", "x100"], typer.Option(help="Of errors: cm at 1.9 m2 of skin, or sqrt(area of the target) / 100.")
    ] = "cm"
    values: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="A number per vertex, as a color map (.npy .csv); or three, as a colour. Once for each shape.",
        ),
    ] = None
    title: Annotated[
        str | None, typer.Option(metavar="TEXT", help="What the numbers of --values are, with their unit.")
    ] = None
    range: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="LOW HIGH", help="Ends of the scale of a heat; chosen if not given."),
    ] = None
    labels: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE", help="A label for each vertex or face (.npy .csv .txt .json). Once for each shape."
        ),
    ] = None
    on: Annotated[
        Literal["vertices", "faces"] | None,
        typer.Option(help="What the labels belong to; told by their count if not given."),
    ] = None
    fit: Annotated[
        str | None,
        typer.Option(
            metavar="MESH|MODEL",
            help="Over one shape: the template that `meshmatch register` laid on it, or a model whose template is "
            "laid on it now. The distance is drawn as a color map.",
        ),
    ] = None
    image: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A texture for a shape whose file names none, or another one.")
    ] = None
    plain: Annotated[bool, typer.Option("--plain", help="Without textures, colours and nodes.")] = False
    seed: Seed = 0

    @property
    def files(self) -> list[Path | None]:
        """All that is read beside the shapes."""
        lists = [*(self.values or []), *(self.labels or []), *(self.points or ())]
        return [self.map, self.image, self.truth, None if self.fit is None else Path(self.fit), *lists]

    def check(self, count: int) -> None:
        """Refuse what does not go together, for so many shapes (`OptionError`)."""
        known = check_truth(self.truth, self.points)
        modes = {"--map": self.map, "--values": self.values, "--labels": self.labels, "--fit": self.fit}
        chosen = [name for name, given in modes.items() if given]
        if self.image is not None:
            chosen.append("--image")
        if self.plain:
            chosen.append("--plain")
        if len(chosen) > 1:
            raise OptionError(f"{' and '.join(chosen)} do not go together", "make a picture for each")
        if self.map is not None and count != 2:
            raise OptionError(f"a map is of two shapes, not of {count}", "name the source, then the target")
        for name, wanted in (("--confidence", self.confidence), ("--truth and --points", known)):
            if wanted and self.map is None:
                raise OptionError(f"{name} need a map" if "and" in name else f"{name} needs a map", "add --map")
        if self.confidence and known:
            raise OptionError("--confidence and the truth both color the shapes", "make a picture for each")
        for name, files in (("--values", self.values), ("--labels", self.labels)):
            if files and len(files) != count:
                raise OptionError(f"{count} shapes need {name} {count} times, not {len(files)}")
        for name, given in (("--fit", self.fit), ("--image", self.image)):
            if given is not None and count != 1:
                raise OptionError(f"{name} is for one shape, not for {count}")
        if self.on is not None and not self.labels:
            raise OptionError("--on needs --labels", "give the labels, or leave out --on")
        if self.title is not None and not self.values:
            raise OptionError("--title needs --values", "give the values, or leave out --title")
        if self.range is not None and not (self.values or self.fit or known):
            raise OptionError("--range needs a color scale", "it goes with --values, --truth, --points and --fit")


@dataclass(frozen=True)
class LookOptions:
    """How it is shown."""

    view: Annotated[View, typer.Option(help="The side that is shown.")] = "quarter"
    up: Annotated[Axis | None, typer.Option(help="The files' axis that points up. Guessed if not given.")] = None
    front: Annotated[Axis | None, typer.Option(help="The files' axis that the shapes face. Guessed if not given.")] = (
        None
    )
    size: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Width and height in pixels, such as 1200x800. Fitted if not given."),
    ] = None
    background: Annotated[
        str, typer.Option(metavar="COLOR", help="white, dark, transparent, or a colour such as #e8f0f8.")
    ] = "white"
    ground: Annotated[bool, typer.Option("--ground/--no-ground", help="Whether shadows fall.")] = True

    def look(self) -> "Look":
        """The same for the library."""
        from meshmatch.render.layout import VIEWS
        from meshmatch.render.picture import Look

        check_axes(self.up, self.front)
        return Look(_size(self.size), self.background, self.up, self.front, *VIEWS[self.view], self.ground)


def _size(text: str | None) -> tuple[int, int] | None:
    """Width and height of words such as 1200x800 (`OptionError` if invalid)."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isascii() and width.isdigit() and height.isascii() and height.isdigit()):
        raise OptionError(f"invalid size '{text}'", "give width and height in pixels, such as 1200x800")
    if max(len(width), len(height)) > 9:
        raise OptionError(f"a picture of {text} pixels is too large", "give a size such as 1200x800")
    return int(width), int(height)


@dataclass(frozen=True)
class Subject:
    """A shape that was named, with its textures or colors if it has any, and its template if it is one."""

    name: str
    shape: "Shape"
    appearance: "Appearance | None" = None
    template: "Template | None" = None


def load_subject(path: Path, options: PictureOptions) -> Subject:
    """Read a shape, or a template by its file or name, or that of a model."""
    from meshmatch.shapes.files import load_shape
    from meshmatch.shapes.textured_files import find_appearance

    template = _template(path)
    if template is not None:
        return Subject(template.name, template.shape, None, template)
    shape = load_shape(path)
    textured = not (options.plain or options.map or options.values or options.labels or options.fit)
    return Subject(path.name, shape, find_appearance(path, shape, options.image) if textured else None)


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
    from meshmatch.errors import ModelError
    from meshmatch.models.registry import TEMPLATE, locate_model

    try:
        return load_template(locate_model(str(path)) / TEMPLATE)
    except ModelError:
        return None  # a missing shape is told as such


def compose(options: PictureOptions, subjects: list[Subject], look: "Look", voice: Console) -> "Composition":
    """Read what the options name, and compose the picture of it."""
    from meshmatch.render.compose import compose_labels, compose_shapes, compose_values, merge_labels

    shapes = [subject.shape for subject in subjects]
    if options.map is not None:
        return _compose_map(options, shapes, look)
    if options.fit is not None:
        return _compose_fit(options, options.fit, shapes[0], look, voice)
    if options.values:
        from meshmatch.transfer.value_files import load_values

        tables = [load_values(*pair).numbers for pair in zip(options.values, shapes, strict=True)]
        colors = all(table.ndim == 2 and table.shape[1] > 1 for table in tables)
        title = options.title or ("" if colors else options.values[0].stem)
        return compose_values(shapes, tables, title, options.range)
    if options.labels:
        from meshmatch.transfer.label_files import load_labels

        labels = [load_labels(*pair, options.on) for pair in zip(options.labels, shapes, strict=True)]
        return compose_labels(shapes, *merge_labels(labels), [own.on == "faces" for own in labels])
    return compose_shapes([(each.template or each.shape, each.appearance) for each in subjects], plain=options.plain)


def _compose_map(options: PictureOptions, shapes: "list[Shape]", look: "Look") -> "Composition":
    from meshmatch.maps.files import load_map
    from meshmatch.render.compose import compose_confidence, compose_errors, compose_match

    assert options.map is not None
    source, target = shapes
    found = load_map(options.map, source, target)
    if options.confidence:
        return compose_confidence(source, target, found, look)
    if not check_truth(options.truth, options.points):
        return compose_match(source, target, found, look=look)
    from meshmatch.maps.evaluate import map_errors
    from meshmatch.maps.geodesics import GeodesicDistances

    here, there = load_truth(options.truth, options.points, source)
    assert here is not None and there is not None
    errors = map_errors(found.index, here, there, GeodesicDistances(target))
    return compose_errors(source, target, found, (here, there), errors, options.unit, options.range, look)


def _compose_fit(options: PictureOptions, fit: str, shape: "Shape", look: "Look", voice: Console) -> "Composition":
    """The template over a shape, from the file of a fit or by a model, which is fitted now."""
    from meshmatch.render.compose import compose_fit
    from meshmatch.shapes.files import SUFFIXES, load_shape

    file = Path(fit)
    if file.is_file() or file.suffix.lower() in SUFFIXES:
        return compose_fit(shape, load_shape(file), limits=options.range)
    from meshmatch.api.matching import register
    from meshmatch.fitting.fit_config import FitConfig
    from meshmatch.models.registry import locate_model
    from meshmatch.shapes.shape import Shape

    locate_model(fit)
    config = FitConfig(seed=options.seed, up=look.up, front=look.front)
    with voice.progress() as report:
        found = register(shape, model=fit, config=config, progress=report)
    voice.say(f"fitted the template of {fit} to {shape.name}: {fit_words(found)}")
    fitted = Shape(found.points_in_file, found.faces, f"{fit} on {shape.name}")
    return compose_fit(shape, fitted, found.frame.rotation, options.range)
