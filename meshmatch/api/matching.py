"""`match` and `register`: two shapes in, a map out; one shape in, a fit out; by a model of either kind."""

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
    """What fits and maps shapes by a model of either kind."""
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
    """Match two shapes: ``map.index[i]`` of the result is the vertex of the target matched to vertex i of the source.

    Where a whole file cannot be fitted, such as a body on a floor, its parts are tried one by one; ``notes`` of the
    result say which were left out.

    Parameters
    ----------
    source
        A mesh or point cloud, in any unit, orientation and resolution: a path, a `Shape`, an
        (N, 3) array, a pair (vertices, faces), or a mesh of another library.
    target
        The same, for the shape it is matched to.
    model
        Name in the registry, model folder, or what `load_model` or `load_implicit` returned; "auto" chooses the installed
        model for this kind of shape, and where none knows either shape they are matched directly, as with "none". An
        implicit model reads ``.npz`` samples too, and obeys the seed of a config alone.
    config
        How shapes are fitted; a pair holds one for the source and one for the target, which may differ in their axes.
    landmarks
        Known pairs: source vertices (N,), target vertices (N,). They pull both fits; the map names the pairs it misses,
        and is then not good. Only with ``refine="nodes"``.
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
        A shape cannot be read or fitted, the model is unknown, or choices contradict each other.

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
        Threads of the numerical libraries; more than one may change the last bits.
    progress
        As in `match`.

    Returns
    -------
    Fit
        Its ``points_in_file`` (V, 3) are the template's vertices on the shape, in the frame and unit of the file. By an
        implicit model an `ImplicitFit`, whose ``shape`` is its template on the shape.

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
