"""Transfer of clothes, hair and other worn meshes between shapes."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from meshmatch.api.results import MapPair, MovedMesh
from meshmatch.api.skeletons import bind_garment, move_skeleton
from meshmatch.api.transfer import MapLike, find_maps
from meshmatch.api.upright import turn_upright
from meshmatch.arrays import Int, Ints
from meshmatch.outputs import as_path
from meshmatch.shapes.deformed_files import check_insertion, save_moved
from meshmatch.shapes.files import ShapeLike, as_shape
from meshmatch.threads import thread_limit
from meshmatch.transfer.garment import carry_garment


@dataclass(frozen=True, eq=False, repr=False)
class GarmentResult(MovedMesh):
    """A garment on the target: the result of `transfer_garment`.

    Attributes
    ----------
    shape
        The garment in the frame and unit of the target; vertices and faces in their original order.
    turns
        (V, 3, 3) rotation of the garment at each vertex.
    pushed
        (N,) vertices that were pushed out, since they would lie deeper below the target's skin than below the source's.
    sunk
        (M,) vertices that lie above the source's skin, but still below the target's.
    below
        Share (0..1) of the garment's vertices below the source's skin.
    far
        Share (0..1) of the garment's vertices farther from the source's skin than 5 % of sqrt(area).
    sits
        Whether ``below`` and ``far`` are low enough for a garment of the source, in the source's pose.
    maps
        The maps that were used.
    seconds
        Wall time, excluding the match.
    original
        The garment's file, if it was read from one.
    binding
        The skeleton that moves the garment in a .glb: the target's, or else the garment's own, moved with it.
    turn
        (3, 3) rotation that makes y the up axis, as .glb requires; None if it is already, or the up axis is unknown.
    body
        The target's file, if it was read from one.

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
        """Write the garment, as `MovedMesh.save` does, or the target together with the garment.

        Parameters
        ----------
        path
            The output file; its suffix selects the format.
        join
            Add the garment to the scene of the target, a .glb, .gltf or .vrm, and write both as one .glb (or .vrm); the
            target's skeleton moves both.

        Raises
        ------
        OptionError
            The suffix is unknown, a material would replace another file, or the two cannot be joined.
        OutputError
            A file cannot be written.
        """
        if join:
            check_insertion(self.body, as_path(path))
        into = self.body if join else None
        save_moved(path, self.original, self.shape, self.turns, self.binding, self.turn, into)

    def _repr_html_(self) -> str:
        from meshmatch.api.notebook import transfer_html
        from meshmatch.render.compose import compose_garments

        sunk = f"{len(self.pushed)} pushed out, {len(self.sunk)} below the skin"
        draw = partial(compose_garments, [self.maps.target], [self.shape])
        return transfer_html("Garment", self.maps.forward, draw, {"vertices of the garment": sunk})


def transfer_garment(garment: ShapeLike, source: ShapeLike, target: ShapeLike, match: MapLike = None) -> GarmentResult:
    """Transfer a mesh that is worn by the source (clothes, hair, a hat, shoes) to the target.

    Each vertex of the garment follows the nearest vertices of the source through the map and keeps its offset from them,
    rotated and scaled as the body is there. Vertices that would sink below the target's skin are pushed out; vertices below
    the source's skin stay equally deep.

    Parameters
    ----------
    garment
        The mesh to transfer, in the frame and unit of the source.
    source
        The mesh that wears the garment.
    target
        The body that will wear it. If its file has a skeleton, the skeleton also moves the garment. If it is a point cloud,
        no vertices are pushed out.
    match
        As in `find_maps`.

    Returns
    -------
    GarmentResult
        The garment on the target; ``save("worn.obj")`` writes it.

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
