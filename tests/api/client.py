"""A sample user script for type checking: mypy checks it together with the package.

It uses every public name (`test_public_names.py`) and is not run.
"""

import warnings
from pathlib import Path
from typing import assert_type

import numpy as np
import torch

import meshmatch
from meshmatch import FitConfig, Matcher
from meshmatch.api.pictures import Page
from meshmatch.api.prepare import Prepared
from meshmatch.arrays import Floats
from meshmatch.collections.asymmetry import Asymmetry
from meshmatch.collections.atlas import Projection
from meshmatch.collections.groups import Comparison
from meshmatch.collections.measures import Measures
from meshmatch.fields import NodeField, node_field
from meshmatch.models.card import ModelCard
from meshmatch.transfer.label_files import Labels
from meshmatch.transfer.landmarks import Landmarks
from meshmatch.transfer.weight_files import SkinWeights

verts, faces = np.zeros((4, 3)), np.array([[0, 1, 2], [0, 2, 3]])
result = meshmatch.match("a.ply", (verts, faces), config=FitConfig(seed=1), threads=2)
assert_type(result, meshmatch.MatchResult)
assert_type(result.map, meshmatch.VertexMap)
assert_type(result.map.apply(verts), Floats)
assert_type(result.map.apply(torch.zeros(4, 3)), torch.Tensor)
assert_type(result.source_fit.residual, float)
matcher = Matcher("human")
fits = matcher.fit_all(["a.ply", verts, torch.zeros(4, 3), (torch.zeros(4, 3), torch.from_numpy(faces))])
assert_type(matcher.fit_all(["a.ply"], errors="return"), list[meshmatch.Fit | meshmatch.MeshmatchError])
assert_type(matcher.map(fits[0], fits[1], agree=False), meshmatch.VertexMap)
assert_type(meshmatch.register("a.ply"), meshmatch.Fit | meshmatch.ImplicitFit)
meshmatch.save_fit("a.safetensors", fits[0])
assert_type(meshmatch.load_fit("a.safetensors", "human"), meshmatch.Fit)
assert_type(meshmatch.calibrate("my-model", ["a.ply", verts], threads=1), ModelCard)
assert_type(meshmatch.evaluate(result, "a.ply", "b.ply"), meshmatch.Evaluation)
assert_type(meshmatch.measure_distance("a.ply", fits[0].shape), meshmatch.SurfaceDistance)
assert_type(meshmatch.transfer_values("a.ply", "b.ply", verts, result).data, Floats)
assert_type(meshmatch.transfer_labels("a.ply", "b.ply", "labels.txt", result).data, Labels)
assert_type(meshmatch.transfer_texture("a.glb", "b.ply"), meshmatch.TexturedResult)
assert_type(meshmatch.interpolate(["a.ply", "b.ply"], 5), meshmatch.Interpolation)
assert_type(meshmatch.picture(["a.ply"], "a.png"), tuple[int, int])
assert_type(meshmatch.view("a.ply", "b.ply", "ab.html", result), Page)
assert_type(meshmatch.load_shape("a.ply"), meshmatch.Shape)
assert_type(meshmatch.load_map("ab.npz"), meshmatch.VertexMap)
assert_type(meshmatch.load_model("human"), meshmatch.TrainedModel)
atlas = meshmatch.Collection("fits").atlas(scale="remove")
assert_type(atlas, meshmatch.Atlas)
assert_type(atlas.project(fits[0]), Projection)
assert_type(meshmatch.Atlas.of(np.stack([verts] * 3), faces).compare(["a", "b"], ["c", "d"]), Comparison)
assert_type(meshmatch.measure_atlas(atlas, [verts] * 3), Measures)

warnings.simplefilter("error", meshmatch.MeshmatchWarning)
try:
    loaded = meshmatch.load_map("ab.npz", "a.ply", "b.ply")
except meshmatch.MeshmatchError as error:
    assert_type((error.message, error.hint), tuple[str, str])
meshmatch.save_map("ab.csv", result.map)
meshmatch.save_shape("a.obj", meshmatch.load_shape("a.ply"))
maps = meshmatch.find_maps("a.ply", "b.ply", result)
assert_type(maps, meshmatch.MapPair)
assert_type(maps.backward, meshmatch.VertexMap)
assert_type(meshmatch.Errors(np.array([0.1], np.float32)).share_over(5.0), float)
basis = meshmatch.laplacian_basis("a.ply", 30)
assert_type(basis, meshmatch.LaplacianBasis)
functional = result.map.functional(basis.vectors, basis.vectors, basis.mass)
again = meshmatch.map_from_functional(functional, "a.ply", "b.ply", basis.vectors, basis.vectors)
assert_type(again, meshmatch.VertexMap)
assert_type(fits[0].reasons, tuple[meshmatch.Reason, ...])
assert_type(fits[0].frame, meshmatch.Frame)
rule = meshmatch.ConfidenceRule(0.5, fill=True)
assert_type(meshmatch.transfer_colors("a.ply", "b.ply", match=maps, rule=rule), meshmatch.Transferred[Floats])
assert_type(meshmatch.transfer_weights("a.glb", "b.ply", "a.glb", maps).data, SkinWeights)
assert_type(meshmatch.transfer_landmarks("a.ply", "b.ply", [0], maps).data, Landmarks)
assert_type(meshmatch.measure("body", "b.ply").data, meshmatch.Measurements)
between = meshmatch.Measurement("back", "distance", ("nape", "waist back"))
assert_type(meshmatch.measure("body", "b.ply", [between]).data.values, Floats)
assert_type(meshmatch.transfer_rig("a.glb", "b.ply", maps), meshmatch.RiggedResult)
assert_type(meshmatch.transfer_shapes("a.glb", "b.ply"), meshmatch.BlendShapesResult)
assert_type(meshmatch.transfer_garment("c.ply", "a.ply", "b.ply"), meshmatch.GarmentResult)
assert_type(dict(meshmatch.Transfers(meshmatch.transfer_rig, "a.glb", "in")), dict[str, meshmatch.RiggedResult])
moved = meshmatch.Transfers(meshmatch.transfer_labels, "a.ply", ["b.ply", "in"], labels="labels.txt")
assert_type(dict(moved), dict[str, meshmatch.Transferred[Labels]])
assert_type([record.verdict for record in moved.save("out")], list[str])
assert_type(meshmatch.wrap("a.ply", "b.ply"), meshmatch.WrapResult)
meshmatch.transfer_texture("a.glb", "b.ply", options=meshmatch.BakeOptions(size=512)).save("b.glb")
meshmatch.interpolate(["a.ply", "b.ply"], options=meshmatch.InterpolationOptions(stop=0.5))
assert_type(meshmatch.prepare("shapes", "prepared"), Prepared)
recipe = meshmatch.recipe_for("prepared").changed(minutes=1)
assert_type(recipe, meshmatch.Recipe)
assert_type(meshmatch.train("model", shapes="prepared", recipe=recipe), Path)
assert_type(meshmatch.train_implicit("chairs", "meshes"), Path)
chairs = meshmatch.load_implicit("chairs")
assert_type(chairs, meshmatch.ImplicitModel)
assert_type(meshmatch.fit_implicit(chairs, "a.ply"), meshmatch.ImplicitFit)
assert_type(meshmatch.__version__, str)
assert_type(node_field(verts, verts, 1.0, outside="mask"), NodeField)
assert_type(meshmatch.measure_asymmetry(atlas), Asymmetry)
assert_type(meshmatch.find_symmetry("a.ply"), meshmatch.Symmetry)
