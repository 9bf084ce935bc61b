"""The result of a fit: a template fitted to one shape."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints, PickledFields, table_html
from meshmatch.errors import InputError, OptionError
from meshmatch.fitting.judge.reasons import Reason, Verdict
from meshmatch.fitting.solve.regularity import Regularity
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.trees import cKDTree
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape

if TYPE_CHECKING:
    from trimesh import Trimesh

    from meshmatch.fitting.judge.features import FitFeatures
    from meshmatch.fitting.judge.verdict import Judgement
    from meshmatch.fitting.solve.system import NodeSystem
    from meshmatch.models.trained import TrainedModel


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(PickledFields):
    """A template fitted to one shape.

    Attributes
    ----------
    template_hash
        Hash of the template; fits of different templates cannot be combined.
    frame
        From the shape's file to the core frame (the template's orientation, area about 1).
    points
        (V, 3) template vertices (low resolution) on the shape, core frame.
    vectors
        (K, 3) node vectors, core frame.
    resting
        (V, 3) the same vertices on the rest template, template frame.
    faces
        (F, 3) the template's triangles.
    residual
        Mean distance between template and shape, both ways, normals included (units of sqrt(area)).
    verts
        (N, 3) vertices of the shape, in the frame and unit of its file.
    verdict
        "good", "fair" or "poor".
    reasons
        Why the verdict is not good.
    up
        The axis of the file that is up according to the fit, such as "+y"; empty if the model has no up axis.
    front
        The axis of the file that is the front according to the fit, such as "-z"; empty likewise.
    seconds
        Wall time of the fit.
    seed
        Seed of its random numbers.
    partial
        Whether the shape was fitted as a part; the residual is then from the shape to the template only.
    repaired
        The repaired shape, with the correspondence to the vertices of its file.
    notes
        What was changed in the shape before fitting, and which choices were replaced.
    model
        Name of the model.
    trust
        Probability (0..1) that the fit is right: on a person, to 8 cm on average.
    signs
        The features by which it was judged; None if it was read from a file.
    left_out
        Numbers of the shape's parts that were left out, as only the others are of the model's kind; see `meshmatch info`.
    regularity
        Share of template vertices where the deformation folds (det F <= 0), and mean change of volume, under these node
        vectors; None if it was read from a file without them.
    side
        Log ratio of the template's stretch for the other side (the mirror image, or the shape itself) to that for this one;
        0 if the other side was not tried.

    Examples
    --------
    >>> fit = meshmatch.register("templates/samples/climber.ply")
    >>> print(fit.verdict, fit.trust, fit.up, fit.front)
    >>> fit.points_in_file  # (V, 3), unit of the file
    """

    template_hash: str
    frame: Frame
    points: Float[Floats, "V 3"]
    vectors: Float[Floats, "K 3"]
    resting: Float[Floats, "V 3"]
    faces: Int[Ints, "F 3"]
    residual: float
    verts: Float[Floats, "N 3"]
    verdict: Verdict
    reasons: tuple[Reason, ...]
    up: str
    front: str
    seconds: float
    seed: int
    partial: bool = False
    repaired: Repaired | None = None
    notes: tuple[str, ...] = ()
    model: str = ""
    trust: float = 1.0
    signs: FitFeatures | None = None
    left_out: tuple[int, ...] = ()
    regularity: Regularity | None = None
    side: float = 0.0

    @property
    def shape_name(self) -> str:
        """Name of the fitted shape; empty if it is unknown."""
        return self.repaired.original.name if self.repaired else ""

    def __repr__(self) -> str:
        name = f"{self.shape_name!r}, " if self.shape_name else ""
        part = ", part" if self.partial else ""
        way = f", {self.axes}" if self.axes else ""
        return f"Fit({name}model {self.model!r}, {self.verdict}, trust {self.trust:.2f}{way}{part})"

    def _repr_html_(self) -> str:
        rows = {
            "model": self.model + (", fitted to a part" if self.partial else ""),
            "verdict": "; ".join([self.verdict, *self.reasons]),
            "trust": f"{self.trust:.2f}",
            "axes": self.axes,
            "notes": "; ".join(self.notes),
        }
        return table_html(f"Fit: {self.shape_name or 'a shape'}", rows)

    @property
    def axes(self) -> str:
        """Up and front axes as text; empty if the model has none."""
        return f"up {self.up}, front {self.front}" if self.up else ""

    @cached_property
    def vertex_distance(self) -> Floats:
        """(N,) distance from every vertex of the shape to the nearest template vertex (units of sqrt(area))."""
        return np.asarray(cKDTree(self.points).query(self.frame.apply(self.verts))[0])

    @property
    def points_in_file(self) -> Float[Floats, "V 3"]:
        """Template vertices in the frame and unit of the shape's file."""
        return self.frame.undo(self.points)

    @property
    def shape(self) -> Shape:
        """The fitted template, in the frame and unit of the shape's file."""
        return Shape(self.points_in_file, facing_out(self.faces, self.frame))

    def to_trimesh(self) -> Trimesh:
        """The fitted template as a mesh of trimesh.

        Returns
        -------
        trimesh.Trimesh
            In the frame and unit of the shape's file.
        """
        return self.shape.to_trimesh()

    def check_template(self, expected: str) -> None:
        """Raise an error if the fit is not of the expected template.

        Parameters
        ----------
        expected
            Hash of the template.

        Raises
        ------
        OptionError
            The fit is of another template.
        """
        if self.template_hash != expected:
            raise OptionError(
                f"the fit is of another template ({self.template_hash}, not {expected})",
                "use the model that made the fit",
            )


def check_fit(fit: object) -> None:
    """Raise `InputError` if an object is not a `Fit`."""
    if not isinstance(fit, Fit):
        raise InputError(f"{type(fit).__name__} is not a fit", "register and Matcher.fit make one")


def judged_fit(
    judgement: Judgement,
    system: NodeSystem,
    frame: Frame,
    vectors: Float[Floats, "K 3"],
    upright: bool = True,
    **about: Any,
) -> Fit:
    """Build a `Fit` from node vectors in the core ``frame`` and their judgement; ``about`` are its other attributes.

    ``upright``: the template has a known up axis, so the fit states up and front.
    """
    up, front = (axis_name(frame.rotation[row]) if upright else "" for row in (1, 2))
    return Fit(
        frame=frame,
        points=system.moved(vectors),
        vectors=vectors,
        resting=system.verts,
        faces=system.faces,
        verdict=judgement.verdict,
        reasons=judgement.reasons,
        trust=judgement.trust,
        signs=judgement.features,
        regularity=system.regularity(vectors),
        up=up,
        front=front,
        **about,
    )


def facing_out(faces: Int[Ints, "F 3"], frame: Frame) -> Int[Ints, "F 3"]:
    """Triangles of the template, oriented outwards on the shape; reversed if the shape was fitted as a mirror image."""
    return faces[:, ::-1] if frame.mirrored else faces


def axis_name(direction: Float[Floats, " 3"]) -> str:
    """Name of the signed axis nearest to a direction, such as "+y"."""
    axis = int(np.abs(direction).argmax())
    return ("+" if direction[axis] > 0 else "-") + "xyz"[axis]


def dense_shape(model: TrainedModel, fit: Fit) -> Shape:
    """The dense mesh of a model's template, deformed by a fit, in the frame and unit of the shape's file.

    Raises `OptionError` if the fit is of another template, and `TemplateError` if a vertex has too few nodes in reach.
    """
    template = model.template
    fit.check_template(template.hash)
    verts = np.asarray(template.dense.verts)
    moved = verts + model.field(verts).displaced(fit.vectors)
    return Shape(fit.frame.undo(moved), facing_out(template.dense.faces, fit.frame), template.name)
