"""What ``meshmatch picture`` shows: from options to the panels of a picture."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from meshmatch.cli.console import Console
from meshmatch.cli.truth import load_truth
from meshmatch.errors import OptionError

if TYPE_CHECKING:
    import numpy as np

    from meshmatch.render.figures import Panel
    from meshmatch.render.picture import Look
    from meshmatch.shapes.appearance import Appearance
    from meshmatch.shapes.shape import Shape
    from meshmatch.templates.template import Template

Told = tuple[Path | None, tuple[Path, Path] | None]


@dataclass(frozen=True)
class Asked:
    """The words of the user that say what is shown."""

    map: Path | None
    confidence: bool
    truth: Told | None
    unit: Literal["cm", "x100"]
    values: list[Path]
    title: str | None
    range: tuple[float, float] | None
    labels: list[Path]
    on: Literal["vertices", "faces"] | None
    fit: str | None
    image: Path | None
    plain: bool
    seed: int

    @property
    def files(self) -> list[Path | None]:
        """All that is read beside the shapes."""
        known: list[Path | None] = [self.map, self.image, *self.values, *self.labels]
        if self.fit is not None:
            known.append(Path(self.fit))
        if self.truth is not None:
            known += [self.truth[0], *(self.truth[1] or ())]
        return known

    def check(self, count: int) -> None:
        """Refuse what does not go together, for so many shapes (`OptionError`)."""
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
        for name, wanted in (("--confidence", self.confidence), ("--truth and --points", self.truth)):
            if wanted and self.map is None:
                raise OptionError(
                    f"{name} are about a map" if "and" in name else f"{name} is that of a map", "add --map"
                )
        if self.confidence and self.truth:
            raise OptionError("--confidence and the truth are two heats", "make a picture for each")
        for name, files in (("--values", self.values), ("--labels", self.labels)):
            if files and len(files) != count:
                raise OptionError(f"{count} shapes need {name} {count} times, not {len(files)}")
        for name, given in (("--fit", self.fit), ("--image", self.image)):
            if given is not None and count != 1:
                raise OptionError(f"{name} is for one shape, not for {count}")
        if self.on is not None and not self.labels:
            raise OptionError("--on says what labels belong to", "give them with --labels")
        if self.title is not None and not self.values:
            raise OptionError("--title says what numbers are", "give them with --values")
        if self.range is not None and not (self.values or self.fit or self.truth):
            raise OptionError(
                "--range is that of a heat", "it goes with --values, --truth, --points and --fit"
            )


@dataclass(frozen=True)
class Subject:
    """One shape that was named: with its look if it has one, and its nodes if it is a template."""

    name: str
    shape: "Shape"
    appearance: "Appearance | None" = None
    template: "Template | None" = None


@dataclass(frozen=True)
class Drawn:
    """Panels, how they are looked at, what they show in words, and numbers about it."""

    panels: "list[Panel]"
    look: "Look"
    what: str
    record: dict[str, Any] = field(default_factory=dict)


def load_subject(path: Path, asked: Asked) -> Subject:
    """Read a shape, or a template by its file or name, or that of a model."""
    from meshmatch.shapes.appearance_files import find_appearance
    from meshmatch.shapes.files import load_shape

    template = _template(path)
    if template is not None:
        return Subject(template.name, template.shape, None, template)
    shape = load_shape(path)
    dressed = not (asked.plain or asked.map or asked.values or asked.labels or asked.fit)
    look = find_appearance(path, shape, asked.image) if dressed else None
    return Subject(path.name, shape, look)


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


def compose(asked: Asked, subjects: list[Subject], names: list[str], look: "Look", voice: Console) -> Drawn:
    """The panels that were asked for."""
    if asked.map is not None:
        return _of_map(asked, subjects, (names[0], names[1]), look)
    if asked.fit is not None:
        return _of_fit(asked, subjects[0], names[0], look, voice)
    if asked.values:
        return _of_values(asked, subjects, names, look)
    if asked.labels:
        return _of_labels(asked, subjects, names, look)
    from meshmatch.render.figures import Panel
    from meshmatch.render.fitted import nodes_panel

    panels = []
    for subject, name in zip(subjects, names, strict=True):
        if subject.template is not None and not asked.plain:
            label = f"{name}: {subject.template.K} nodes" if name == subject.name else name
            panels.append(nodes_panel(subject.template, label))
        elif asked.plain:
            panels.append(Panel(subject.shape, _clay(subject.shape), name))
        else:
            panels.append(Panel(subject.shape, label=name, appearance=subject.appearance))
    what = "1 shape" if len(panels) == 1 else f"{len(panels)} shapes"
    return Drawn(panels, look, what)


def _clay(shape: "Shape") -> "np.ndarray":
    import numpy as np

    from meshmatch.render.colors import CLAY

    return np.tile(CLAY, (shape.V, 1))


def _of_map(asked: Asked, subjects: list[Subject], names: tuple[str, str], look: "Look") -> Drawn:
    from meshmatch.maps.files import load_map
    from meshmatch.render import matched

    assert asked.map is not None
    source, target = subjects[0].shape, subjects[1].shape
    found = load_map(asked.map, source, target)
    if asked.confidence:
        panels, scale = matched.confidence_panels(source, target, found, labels=names, look=look)
        record = {"confidence_mean": float(found.confidence.mean())}
        return Drawn(panels, replace(look, legend=scale), "the confidence of the map", record)
    if asked.truth is not None:
        from meshmatch.maps.evaluate import map_errors
        from meshmatch.maps.geodesics import GeodesicDistances

        here, there = load_truth(*asked.truth, source)
        assert here is not None and there is not None
        errors = map_errors(found.index, here, there, GeodesicDistances(target))
        panels, scale = matched.error_panels(
            source, target, found, (here, there), errors, asked.unit, names, asked.range, look
        )
        record = {
            "points": int(errors.values.size),
            "mean_cm": errors.mean_cm,
            "mean_x100": 100 * errors.mean,
        }
        return Drawn(panels, replace(look, legend=scale), "the errors of the map", record)
    panels = matched.match_panels(source, target, found, labels=names, look=look)
    return Drawn(panels, look, "matched places in one colour")


def _of_fit(asked: Asked, subject: Subject, name: str, look: "Look", voice: Console) -> Drawn:
    import numpy as np

    from meshmatch.render.fitted import distances, fit_panels
    from meshmatch.shapes.files import SUFFIXES, load_shape

    assert asked.fit is not None
    file, rotation = Path(asked.fit), None
    if file.is_file() or file.suffix.lower() in SUFFIXES:
        fitted = load_shape(file)
    else:
        from meshmatch import pipeline
        from meshmatch.models.registry import locate_model
        from meshmatch.shapes.shape import Shape

        locate_model(asked.fit)
        with voice.progress() as report:
            fit = pipeline.register(
                subject.shape, model=asked.fit, seed=asked.seed, up=look.up, front=look.front, progress=report
            )
        fitted = Shape(fit.points_in_file, fit.faces, f"{asked.fit} on {name}")
        rotation = fit.frame.rotation
        voice.say(
            f"laid the template of {asked.fit} on {name}: {fit.verdict} fit, up {fit.up}, front {fit.front}"
        )
    panels, scale = fit_panels(subject.shape, fitted, rotation, name, asked.range)
    apart = distances(subject.shape, fitted)
    record = {"distance_mean": float(np.nanmean(apart)), "distance_max": float(np.nanmax(apart))}
    return Drawn(panels, replace(look, legend=scale), "the template over the shape", record)


def _of_values(asked: Asked, subjects: list[Subject], names: list[str], look: "Look") -> Drawn:
    import numpy as np

    from meshmatch.errors import InputError
    from meshmatch.render.figures import Panel
    from meshmatch.render.scales import Scale
    from meshmatch.transfer.value_files import load_values

    loaded = [
        load_values(file, subject.shape).numbers for file, subject in zip(asked.values, subjects, strict=True)
    ]
    numbers = [table[:, 0] if table.ndim == 2 and table.shape[1] == 1 else table for table in loaded]
    if all(table.ndim == 1 for table in numbers):
        title = asked.values[0].stem if asked.title is None else asked.title
        scale = Scale.of(np.concatenate(numbers), title, asked.range)
        panels = [
            Panel(subject.shape, scale.colors(table), name)
            for subject, table, name in zip(subjects, numbers, names, strict=True)
        ]
        record = {"range": [scale.low, scale.high]}
        return Drawn(
            panels, replace(look, legend=scale), f"heat from {scale.low:g} to {scale.high:g}", record
        )
    for file, table in zip(asked.values, numbers, strict=True):
        colors = table.ndim == 2 and table.shape[1] in (3, 4)
        if not colors or not ((table >= 0) & (table <= 1)).all():
            columns = 1 if table.ndim == 1 else table.shape[1]
            raise InputError(
                f"{file.name} has {columns} numbers a vertex, which are neither a heat nor colours",
                "one number each, or red, green and blue in 0..1",
            )
    if asked.title is not None or asked.range is not None:
        raise OptionError("colours have no scale", "leave out --title and --range")
    panels = [
        Panel(subject.shape, table, name)
        for subject, table, name in zip(subjects, numbers, names, strict=True)
    ]
    return Drawn(panels, look, "the colours of a file")


def _of_labels(asked: Asked, subjects: list[Subject], names: list[str], look: "Look") -> Drawn:
    import numpy as np

    from meshmatch.render.carried import labelled
    from meshmatch.render.scales import label_swatches
    from meshmatch.transfer.label_files import load_labels

    loaded = [
        load_labels(file, subject.shape, asked.on)
        for file, subject in zip(asked.labels, subjects, strict=True)
    ]
    # One list of all labels, so that a label has one colour on every shape.
    words = sorted({str(word) for labels in loaded for word in labels.names}, key=_in_order)
    number = {word: k for k, word in enumerate(words)}
    panels, all_codes = [], []
    for labels, subject, name in zip(loaded, subjects, names, strict=True):
        table = np.array([*(number[str(word)] for word in labels.names), -1])
        codes = table[labels.codes]
        all_codes.append(codes)
        panels.append(replace(labelled(subject.shape, codes, labels.on == "faces"), label=name))
    swatches = label_swatches(np.concatenate(all_codes), words)
    return Drawn(panels, replace(look, legend=swatches), f"{len(words)} labels", {"labels": words})


def _in_order(word: str) -> tuple[int, int, str]:
    """Numbers by size, then words by letters."""
    number = word.removeprefix("-").isdecimal()
    return (0, int(word), "") if number else (1, 0, word)
