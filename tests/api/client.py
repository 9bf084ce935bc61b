"""What a user's own script may look like; `mypy --strict` knows all its types (see test_typing.py)."""

import numpy as np

import meshmatch
from meshmatch import FitConfig, Matcher

verts, faces = np.zeros((4, 3)), np.array([[0, 1, 2], [0, 2, 3]])
result = meshmatch.match("a.ply", (verts, faces), config=FitConfig(seed=1), threads=2)
reveal_type(result)  # noqa: F821
reveal_type(result.map)  # noqa: F821
reveal_type(result.source_fit.residual)  # noqa: F821
matcher = Matcher("human")
fits = matcher.fit_all(["a.ply", verts])
reveal_type(matcher.map(fits[0], fits[1], agree=False))  # noqa: F821
reveal_type(meshmatch.register("a.ply"))  # noqa: F821
reveal_type(meshmatch.evaluate(result, "a.ply", "b.ply"))  # noqa: F821
reveal_type(meshmatch.transfer_labels("a.ply", "b.ply", "labels.txt", result).data)  # noqa: F821
reveal_type(meshmatch.transfer_texture("a.glb", "b.ply"))  # noqa: F821
reveal_type(meshmatch.interpolate(["a.ply", "b.ply"], 5))  # noqa: F821
reveal_type(meshmatch.picture(["a.ply"], "a.png"))  # noqa: F821
reveal_type(meshmatch.view("a.ply", "b.ply", "ab.html", result))  # noqa: F821
reveal_type(meshmatch.load_shape("a.ply"))  # noqa: F821
reveal_type(meshmatch.load_map("ab.npz"))  # noqa: F821
reveal_type(meshmatch.load_model("human"))  # noqa: F821
