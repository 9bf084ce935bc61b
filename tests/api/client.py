"""What a user's own script may look like; mypy, which checks it with the package, knows all its types."""

from typing import assert_type

import numpy as np

import meshmatch
from meshmatch import FitConfig, Matcher
from meshmatch.api.pictures import Page
from meshmatch.arrays import Floats
from meshmatch.collections.atlas import Projection
from meshmatch.collections.groups import Comparison
from meshmatch.collections.measures import Measures
from meshmatch.maps.evaluate import Evaluation
from meshmatch.models.trained import TrainedModel
from meshmatch.transfer.label_files import Labels

verts, faces = np.zeros((4, 3)), np.array([[0, 1, 2], [0, 2, 3]])
result = meshmatch.match("a.ply", (verts, faces), config=FitConfig(seed=1), threads=2)
assert_type(result, meshmatch.MatchResult)
assert_type(result.map, meshmatch.VertexMap)
assert_type(result.source_fit.residual, float)
matcher = Matcher("human")
fits = matcher.fit_all(["a.ply", verts])
assert_type(matcher.map(fits[0], fits[1], agree=False), meshmatch.VertexMap)
assert_type(meshmatch.register("a.ply"), meshmatch.Fit | meshmatch.ImplicitFit)
assert_type(meshmatch.evaluate(result, "a.ply", "b.ply"), Evaluation)
assert_type(meshmatch.transfer_values("a.ply", "b.ply", verts, result).data, Floats)
assert_type(meshmatch.transfer_labels("a.ply", "b.ply", "labels.txt", result).data, Labels)
assert_type(meshmatch.transfer_texture("a.glb", "b.ply"), meshmatch.TexturedResult)
assert_type(meshmatch.interpolate(["a.ply", "b.ply"], 5), meshmatch.Interpolation)
assert_type(meshmatch.picture(["a.ply"], "a.png"), tuple[int, int])
assert_type(meshmatch.view("a.ply", "b.ply", "ab.html", result), Page)
assert_type(meshmatch.load_shape("a.ply"), meshmatch.Shape)
assert_type(meshmatch.load_map("ab.npz"), meshmatch.VertexMap)
assert_type(meshmatch.load_model("human"), TrainedModel)
atlas = meshmatch.Collection("fits").atlas(scale="remove")
assert_type(atlas, meshmatch.Atlas)
assert_type(atlas.project(fits[0]), Projection)
assert_type(meshmatch.Atlas.of(np.stack([verts] * 3), faces).compare(["a", "b"], ["c", "d"]), Comparison)
assert_type(meshmatch.measure_atlas(atlas, [verts] * 3), Measures)
