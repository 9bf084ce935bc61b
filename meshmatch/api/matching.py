"""`match` maps one shape to another; `register` fits a model's template to one shape. Models may be implicit ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from meshmatch.api.inputs import LandmarkPairs, checked_threads
from meshmatch.api.matcher import Matcher
from meshmatch.api.results import MatchResult
from meshmatch.errors import needs
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.models.card import ImplicitCard
from meshmatch.models.registry import AUTO, implicit_folder
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import ShapeLike

if TYPE_CHECKING:
    from meshmatch.api.implicit import ImplicitMatcher
    from meshmatch.implicit.fit import ImplicitFit
    from meshmatch.implicit.model import ImplicitModel


def matcher_for(
    model: str | Path | TrainedModel | ImplicitModel,
    config: FitConfig | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> Matcher | ImplicitMatcher:
    """Make a matcher for a model of either kind: a `Matcher`, or an `ImplicitMatcher` for an implicit model."""
    if isinstance(model, str | Path):
        implicit = implicit_folder(model) is not None
    else:
        implicit = isinstance(getattr(model, "card", None), ImplicitCard)
    if not implicit:
        return Matcher(model, config, threads, progress)  # type: ignore[arg-type]
    with needs("torch", "implicit"):
        from meshmatch.api.implicit import ImplicitMatcher
    return ImplicitMatcher(model, config, checked_threads(threads), progress)  # type: ignore[arg-type]


def match(
    source: ShapeLike,
    target: ShapeLike,
    *,
    model: str | Path | TrainedModel | ImplicitModel = AUTO,
    config: FitConfig | Sequence[FitConfig] | None = None,
    landmarks: LandmarkPairs | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> MatchResult:
    """Match two shapes: map every vertex of the source to a vertex of the target.

    In the result, ``map.index[i]`` is the vertex of the target matched to vertex i of the source. If a file cannot be
    fitted as a whole, such as a body on a floor, its parts are tried on their own; ``notes`` of the result say which parts
    were left out.

    Parameters
    ----------
    source
        The shape to map from: a mesh or point cloud in any unit, orientation and resolution. A path, a `Shape`, an
        (N, 3) array of points, a pair (vertices, faces), or a mesh of another library.
    target
        The shape to map to, in any of the same forms.
    model
        Name in the registry, model folder, or what `load_model` or `load_implicit` returned. "auto" chooses the installed
        model for this kind of shape; if no model knows either shape, they are matched directly, as with "none". An
        implicit model also reads ``.npz`` samples, and uses only the seed of a config.
    config
        How shapes are fitted: one for both shapes, or one for each, for example with different axes.
    landmarks
        Known correspondences: source vertices (N,) and target vertices (N,). They guide both fits. If the map misses any
        of them, its ``reasons`` say so and its verdict is not "good". Requires ``refine="nodes"``.
    threads
        How many shapes are fitted at once; 2 by default.
    progress
        Called with the stage, the name of the shape and the share of the stage that is done (0..1).

    Returns
    -------
    MatchResult
        The map with its verdict and confidence, and both fits.

    Raises
    ------
    MeshmatchError
        A shape cannot be read or fitted, the model is unknown, or options contradict each other.

    Examples
    --------
    >>> result = meshmatch.match("templates/samples/climber.ply", "templates/samples/dancer.ply")
    >>> result.map.verdict
    >>> dancer_vertices = result.map.index  # (V_source,)
    """
    return matcher_for(model, None, threads, progress).match(source, target, config, landmarks)


def register(
    shape: ShapeLike,
    *,
    model: str | Path | TrainedModel | ImplicitModel = AUTO,
    config: FitConfig | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> Fit | ImplicitFit:
    """Fit the model's template to one shape (non-rigid registration).

    All fits of a model have the same vertices and triangles in the same order.

    Parameters
    ----------
    shape
        As in `match`.
    model
        As in `match`.
    config
        How the shape is fitted.
    threads
        Threads of the numerical libraries; more than one may change the last bits of the result.
    progress
        As in `match`.

    Returns
    -------
    Fit
        Its ``points_in_file`` (V, 3) are the vertices of the deformed template, in the frame and unit of the file. For an
        implicit model, an `ImplicitFit`, whose ``shape`` is the deformed template.

    Raises
    ------
    MeshmatchError
        As for `match`.

    Examples
    --------
    >>> fit = meshmatch.register("templates/samples/climber.ply")
    >>> fit.verdict, fit.residual
    >>> meshmatch.save_shape("fitted.ply", fit.shape)
    """
    return matcher_for(model, config, threads, progress).fit(shape)
