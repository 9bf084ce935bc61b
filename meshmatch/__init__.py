"""Dense matching of non-rigid 3D shapes.

The public names are imported on first use, so that importing `meshmatch` itself is cheap. The site describes them; its
pages are listed in docs/reference.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING

__version__ = "0.3.0"

if TYPE_CHECKING:
    from meshmatch.api.blend_shapes import BlendShapesResult as BlendShapesResult
    from meshmatch.api.blend_shapes import transfer_shapes as transfer_shapes
    from meshmatch.api.calibration import calibrate as calibrate
    from meshmatch.api.fits import load_fit as load_fit
    from meshmatch.api.fits import save_fit as save_fit
    from meshmatch.api.garment import GarmentResult as GarmentResult
    from meshmatch.api.garment import transfer_garment as transfer_garment
    from meshmatch.api.interpolation import Interpolation as Interpolation
    from meshmatch.api.interpolation import InterpolationOptions as InterpolationOptions
    from meshmatch.api.interpolation import interpolate as interpolate
    from meshmatch.api.matcher import Matcher as Matcher
    from meshmatch.api.matching import match as match
    from meshmatch.api.matching import register as register
    from meshmatch.api.measure import measure as measure
    from meshmatch.api.pictures import picture as picture
    from meshmatch.api.pictures import view as view
    from meshmatch.api.prepare import prepare as prepare
    from meshmatch.api.results import ConfidenceRule as ConfidenceRule
    from meshmatch.api.results import MapPair as MapPair
    from meshmatch.api.results import MatchResult as MatchResult
    from meshmatch.api.results import Transferred as Transferred
    from meshmatch.api.results import evaluate as evaluate
    from meshmatch.api.results import measure_distance as measure_distance
    from meshmatch.api.rig import RiggedResult as RiggedResult
    from meshmatch.api.rig import transfer_rig as transfer_rig
    from meshmatch.api.symmetry import Symmetry as Symmetry
    from meshmatch.api.symmetry import find_symmetry as find_symmetry
    from meshmatch.api.texture import TexturedResult as TexturedResult
    from meshmatch.api.texture import transfer_texture as transfer_texture
    from meshmatch.api.transfer import find_maps as find_maps
    from meshmatch.api.transfer import transfer_colors as transfer_colors
    from meshmatch.api.transfer import transfer_labels as transfer_labels
    from meshmatch.api.transfer import transfer_landmarks as transfer_landmarks
    from meshmatch.api.transfer import transfer_values as transfer_values
    from meshmatch.api.transfer import transfer_weights as transfer_weights
    from meshmatch.api.wrap import WrapResult as WrapResult
    from meshmatch.api.wrap import wrap as wrap
    from meshmatch.collections.asymmetry import measure_asymmetry as measure_asymmetry
    from meshmatch.collections.atlas import Atlas as Atlas
    from meshmatch.collections.collection import Collection as Collection
    from meshmatch.collections.measures import measure_atlas as measure_atlas
    from meshmatch.collections.transfers import Transfers as Transfers
    from meshmatch.errors import MeshmatchError as MeshmatchError
    from meshmatch.errors import MeshmatchWarning as MeshmatchWarning
    from meshmatch.fitting.fit import Fit as Fit
    from meshmatch.fitting.fit_config import FitConfig as FitConfig
    from meshmatch.fitting.judge.reasons import Reason as Reason
    from meshmatch.geometry.frames import Frame as Frame
    from meshmatch.implicit.codes import fit_implicit as fit_implicit
    from meshmatch.implicit.fit import ImplicitFit as ImplicitFit
    from meshmatch.implicit.model import ImplicitModel as ImplicitModel
    from meshmatch.implicit.model import load_implicit as load_implicit
    from meshmatch.implicit.training import train_implicit as train_implicit
    from meshmatch.maps.evaluate import Errors as Errors
    from meshmatch.maps.evaluate import Evaluation as Evaluation
    from meshmatch.maps.evaluate import SurfaceDistance as SurfaceDistance
    from meshmatch.maps.files import load_map as load_map
    from meshmatch.maps.files import save_map as save_map
    from meshmatch.maps.functional import LaplacianBasis as LaplacianBasis
    from meshmatch.maps.functional import laplacian_basis as laplacian_basis
    from meshmatch.maps.functional import map_from_functional as map_from_functional
    from meshmatch.maps.vertex_map import VertexMap as VertexMap
    from meshmatch.models.registry import load_model as load_model
    from meshmatch.models.trained import TrainedModel as TrainedModel
    from meshmatch.shapes.files import load_shape as load_shape
    from meshmatch.shapes.files import save_shape as save_shape
    from meshmatch.shapes.shape import Shape as Shape
    from meshmatch.training.recipes import Recipe as Recipe
    from meshmatch.training.recipes import recipe_for as recipe_for
    from meshmatch.training.train import train as train
    from meshmatch.transfer.bake import BakeOptions as BakeOptions
    from meshmatch.transfer.measurements import Measurement as Measurement
    from meshmatch.transfer.measurements import Measurements as Measurements

_PUBLIC = {
    "api.blend_shapes": "BlendShapesResult transfer_shapes",
    "api.calibration": "calibrate",
    "api.fits": "load_fit save_fit",
    "api.garment": "GarmentResult transfer_garment",
    "api.interpolation": "Interpolation InterpolationOptions interpolate",
    "api.matcher": "Matcher",
    "api.matching": "match register",
    "api.measure": "measure",
    "api.pictures": "picture view",
    "api.prepare": "prepare",
    "api.results": "ConfidenceRule MapPair MatchResult Transferred evaluate measure_distance",
    "api.rig": "RiggedResult transfer_rig",
    "api.symmetry": "Symmetry find_symmetry",
    "api.texture": "TexturedResult transfer_texture",
    "api.transfer": "find_maps transfer_colors transfer_labels transfer_landmarks transfer_values transfer_weights",
    "api.wrap": "WrapResult wrap",
    "collections.asymmetry": "measure_asymmetry",
    "collections.atlas": "Atlas",
    "collections.collection": "Collection",
    "collections.measures": "measure_atlas",
    "collections.transfers": "Transfers",
    "errors": "MeshmatchError MeshmatchWarning",
    "fitting.fit": "Fit",
    "fitting.fit_config": "FitConfig",
    "fitting.judge.reasons": "Reason",
    "geometry.frames": "Frame",
    "implicit.codes": "fit_implicit",
    "implicit.fit": "ImplicitFit",
    "implicit.model": "ImplicitModel load_implicit",
    "implicit.training": "train_implicit",
    "maps.evaluate": "Errors Evaluation SurfaceDistance",
    "maps.files": "load_map save_map",
    "maps.functional": "LaplacianBasis laplacian_basis map_from_functional",
    "maps.vertex_map": "VertexMap",
    "models.registry": "load_model",
    "models.trained": "TrainedModel",
    "shapes.files": "load_shape save_shape",
    "shapes.shape": "Shape",
    "training.recipes": "Recipe recipe_for",
    "training.train": "train",
    "transfer.bake": "BakeOptions",
    "transfer.measurements": "Measurement Measurements",
}
_MODULE_OF = {name: f"meshmatch.{module}" for module, names in _PUBLIC.items() for name in names.split()}

_NEED_TORCH = ("meshmatch.implicit.", "meshmatch.training.")


def _has_torch() -> bool:
    try:
        return find_spec("torch") is not None
    except ImportError:
        return False


# Without torch only the names that do not need it, so that `import *`, `help` and `inspect` work.
__all__ = ["__version__", *sorted(_MODULE_OF)]  # noqa: PLE0604  (names come from __getattr__)
if not _has_torch():
    __all__ = [name for name in __all__ if not _MODULE_OF.get(name, "").startswith(_NEED_TORCH)]


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'meshmatch' has no attribute {name!r}")
    from importlib import import_module

    from meshmatch.errors import needs

    extra = "implicit" if _MODULE_OF[name].startswith("meshmatch.implicit") else "train"
    with needs("torch", extra):
        value = getattr(import_module(_MODULE_OF[name]), name)
    globals()[name] = value  # later accesses bypass this function
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
