"""Clothes, hair and other things that sit on a shape, from one shape to another."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from meshmatch.api.bound import bind_garment, move_skeleton
from meshmatch.api.results import MapPair, MovedMesh
from meshmatch.api.transfer import MapLike, find_maps
from meshmatch.api.upright import turn_upright
from meshmatch.arrays import Int, Ints
from meshmatch.outputs import as_path
from meshmatch.shapes.files import ShapeLike, as_shape
from meshmatch.shapes.moved_files import check_into, save_moved
from meshmatch.threads import thread_limit
from meshmatch.transfer.garment import carry_garment


@dataclass(frozen=True, eq=False, repr=False)
class GarmentResult(MovedMesh):
    """A garment on another body.

    Attributes
    ----------
    shape
        The garment's vertices and faces in their order, in the frame and unit of the target.
    turns
        (V, 3, 3) how each vertex was turned.
    pushed
        (N,) vertices that would have sunk deeper below the target's skin than below the source's, and were pushed out.
    sunk
        (M,) vertices that are below the target's skin all the same, and are above the source's.
    below
        Share (0..1) of its vertices below the source's skin.
    far
        Share (0..1) of its vertices further from the source's skin than 5 % of sqrt(area).
    sits
        Whether these say that it sits on the source; another person's clothes, or another pose's, do not.
    maps
        The maps that were followed.
    seconds
        Time beside the match.
    original
        The garment's file, if it came from one.
    binding
        The skeleton that moves the garment in a .glb: the target's, or else its own, carried along.
    turn
        (3, 3) the rotation after which it stands along y, as a .glb does; None where it stands so, or that is not known.
    body
        The target's file, if it came from one.

    Examples
    --------
    >>> result = meshmatch.transfer_garment("shirt.obj", "templates/samples/dancer.ply", "templates/samples/climber.ply")
    >>> result.save("climbers-shirt.obj")  # the text of shirt.obj with other positions
    """

    pushed: Int[Ints, " N"]
    sunk: Int[Ints, " M"]
    below: float
    far: float
    sits: bool
    maps: MapPair
    seconds: float
    body: Path | None = None

    def save(self, path: str | Path, join: bool = False) -> None:
        """Write the garment, as `MovedMesh.save`; or the target with the garment in it.

        Parameters
        ----------
        path
            Where to.
        join
            Put the garment into the target's file, a .glb, .gltf or .vrm, and write both as one .glb; a skeleton of the
            target moves both.

        Raises
        ------
        OptionError
            The suffix is unknown, a material would replace another file, or the two cannot be joined.
        OutputError
            A file cannot be written.
        """
        if join:
            check_into(self.body, as_path(path))
        into = self.body if join else None
        save_moved(path, self.original, self.shape, self.turns, self.binding, self.turn, into)

    def _repr_html_(self) -> str:
        from meshmatch.api.notebook import carried_html
        from meshmatch.render.compose import compose_worn

        sunk = f"{len(self.pushed)} pushed out, {len(self.sunk)} below the skin"
        draw = partial(compose_worn, [self.maps.target], [self.shape])
        return carried_html("Garment", self.maps.forward, draw, {"vertices of the garment": sunk})


def transfer_garment(garment: ShapeLike, source: ShapeLike, target: ShapeLike, match: MapLike = None) -> GarmentResult:
    """A mesh that sits on the source (clothes, hair, a hat, shoes), as it sits on the target.

    Each vertex of the garment follows the nearest vertices of the source through the map, with its offset from them,
    turned and scaled as the body is there. It is pushed out where it would sink below the target's skin; what is below
    the source's skin stays as deep.

    Parameters
    ----------
    garment
        The mesh to carry, in the frame and unit of the source.
    source
        The body that it sits on: a mesh.
    target
        The body that it will sit on; if its file has a skeleton, that moves the garment too. Out of a point cloud nothing
        is pushed.
    match
        As in `find_maps`.

    Returns
    -------
    GarmentResult
        Its ``save("worn.obj")`` writes the garment.

    Raises
    ------
    MeshmatchError
        The garment is not on the source, the source is a point cloud or matches as a mirror image; or as for
        `find_maps`.

    Examples
    --------
    >>> body = meshmatch.load_shape("templates/samples/dancer.ply")
    >>> glove = meshmatch.Shape(body.verts + 0.005 * body.vertex_normals, body.faces)
    >>> meshmatch.transfer_garment(glove, body, "templates/samples/climber.ply").shape
    """
    original = Path(garment) if isinstance(garment, str | Path) else None
    cloth = as_shape(garment, "garment")
    body = Path(target) if isinstance(target, str | Path) else None
    source, target = as_shape(source, "source"), as_shape(target, "target")
    maps = find_maps(source, target, match)
    began = time.monotonic()
    with thread_limit(1):
        found = carry_garment(cloth, maps.forward, maps.source, maps.target, maps.threads)
        shape = replace(cloth, verts=found.verts)
        binding = bind_garment(maps, body, cloth, original) or move_skeleton(original, shape, target.upright)
        turn = None if target.upright else turn_upright(maps, source.upright)
    seconds = time.monotonic() - began
    return GarmentResult(
        shape,
        found.turns,
        found.pushed,
        found.sunk,
        found.below,
        found.far,
        found.sits,
        maps,
        seconds,
        body,
        original=original,
        binding=binding,
        turn=turn,
    )
