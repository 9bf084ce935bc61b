"""Transfer of skeletons, skin weights and animation clips between shapes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from scipy.sparse import csr_array

from meshmatch.api.results import MapPair
from meshmatch.api.skeletons import INFLUENCES
from meshmatch.api.transfer import MapLike, find_maps
from meshmatch.api.upright import vertex_weights
from meshmatch.arrays import ShortRepr
from meshmatch.errors import InputError, OptionError, warn
from meshmatch.fitting.search.frames import axis_vector
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.outputs import as_path, replace_on_success
from meshmatch.shapes import tables
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.copies import counterparts
from meshmatch.shapes.deformed_files import add_appearance, warn_about_lost
from meshmatch.shapes.files import ShapeLike, as_gltf_scene, as_shape, load_shape
from meshmatch.shapes.formats import gltf, gltf_vrm
from meshmatch.shapes.formats.gltf_add_skeleton import with_skeleton
from meshmatch.shapes.formats.gltf_attachments import find_rigid_groups, find_separate_figures, find_skins
from meshmatch.shapes.formats.gltf_edit import record_source_mesh
from meshmatch.shapes.formats.gltf_humanoid import HumanoidBones, find_humanoid_bones, with_humanoid_bones
from meshmatch.shapes.formats.gltf_rig import Binding, Rig, read_rig
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape
from meshmatch.threads import thread_limit
from meshmatch.transfer.attributes import joint_table, most_votes, pull_weights
from meshmatch.transfer.carry_rig import UP, rotation_to_upright, transfer_skeleton
from meshmatch.transfer.clean_weights import clean_weights, find_uncovered, make_rigid
from meshmatch.transfer.retarget_clips import points_at_start, standing_clips
from meshmatch.transfer.weight_files import SkinWeights, load_weights

Pose = Literal["rest", "source"]
"""Pose of a rigged target: as in its own file, or as the source's."""
# Copies of a figure are at least this far from it, in units of its diagonal; set by hand.
_COPY_DISTANCE = 0.1
# A clip lies if the cosine between y and the file's up axis, as the clip moves it, is below this; names in a warning.
_LYING_COSINE, _MAX_LISTED = 0.5, 5
_MAX_ANISOTROPY = 1.05  # largest over smallest scale of a joint; set by hand
check_rig_suffix = partial(tables.check_suffix, suffixes=(".glb", gltf_vrm.SUFFIX), what="rigs")


@dataclass(frozen=True, eq=False, repr=False)
class RiggedResult(ShortRepr):
    """The target with the source's skeleton: the result of `transfer_rig`.

    Attributes
    ----------
    rig
        The skeleton as in the written file: ``names``, ``parents``, ``joints``, ``clips``, and ``worlds()``, (N, 4, 4). Its
        first node is new and has the name of the source's file.
    weights
        Skin weights of the target's vertices for the joints.
    unused
        Names of joints that move vertices of the source but none of the target.
    replaced
        Number of joints of the target's own skeleton that are no longer used.
    replaced_clips
        Names of the target's own clips that no longer move it.
    maps
        The maps that were used.
    glb
        Content of the .glb file.
    source
        The source's file.
    original
        The target's file, if it was read from one.
    lost
        Description of what the target's file has and the glb does not.

    Examples
    --------
    >>> result = meshmatch.transfer_rig("soldier.glb", "templates/samples/climber.ply")
    >>> result.rig.names, result.unused
    >>> result.save("rigged.glb")
    """

    rig: Rig
    weights: SkinWeights
    unused: tuple[str, ...]
    replaced: int
    replaced_clips: tuple[str, ...]
    maps: MapPair
    glb: bytes
    source: Path
    original: Path | None = None
    lost: str = ""

    def _repr_html_(self) -> str:
        from meshmatch.api.notebook import transfer_html
        from meshmatch.render.compose import compose_labels

        heaviest, target = most_votes(self.weights.matrix), self.maps.target
        draw = partial(compose_labels, [target], [heaviest], self.weights.names)
        more = {
            "joints": f"{len(self.rig.joints)}, {len(self.unused)} of them without a vertex on the target",
            "clips": ", ".join(clip.name for clip in self.rig.clips),
        }
        return transfer_html("Rig", self.maps.forward, draw, more)

    def save(self, path: str | Path) -> None:
        """Write the rigged target.

        Parameters
        ----------
        path
            A .glb; or a .vrm, if the target is one: its humanoid bones then refer to the new skeleton.

        Raises
        ------
        OptionError
            The suffix is not supported; or it is .vrm, and the target is not a .vrm, or the humanoid bones of the new
            skeleton are unknown.
        OutputError
            The file cannot be written.
        """
        path = as_path(path)
        check_rig_output(path, self.source, self.original)
        with replace_on_success(path) as temporary:
            write_rig(self, path, temporary)


def write_rig(result: RiggedResult, output: Path, place: Path) -> None:
    """Write the result for ``output`` to the temporary path ``place``; warn of what is lost.

    Errors are as for `RiggedResult.save`.
    """
    person, glb = check_rig_output(output, result.source, result.original), result.glb
    if person is not None:
        name = output if result.original is None else result.original
        glb = gltf.parse_document(name, glb, "scene makes", lambda document: with_humanoid_bones(document, person))
    place.write_bytes(glb)
    warn_about_lost(output, result.original, result.lost)


def check_rig_output(path: Path, source: Path, target: Path | None) -> HumanoidBones | None:
    """Check an output before the transfer; return the humanoid bones for a .vrm, else None.

    `OptionError` if the format does not support rigs, or the humanoid bones of the source's skeleton are unknown.
    """
    if check_rig_suffix(path) != gltf_vrm.SUFFIX:
        return None
    gltf_vrm.check_character(target, path)
    assert target is not None

    def find_person(document: gltf.Document) -> HumanoidBones | None:
        return gltf.parse_document(
            target, read_bytes(target), "scene makes", lambda body: find_humanoid_bones(document, body)
        )

    person = gltf.parse_document(source, read_bytes(source), "skeleton makes", find_person)
    if person is None:
        problem = f"{path.name} would be no character: the humanoid bones of {source.name} are unknown"
        raise OptionError(
            problem, "end the name in .glb, or give a source that is a .vrm, or has the target's names of bones"
        )
    return person


def _warn_of_stretched_joints(name: str, rig: Rig) -> None:
    """Warn that clips will look different if joints of the source have a non-uniform scale."""
    sizes = np.linalg.svd(rig.worlds()[rig.joints][:, :3, :3], compute_uv=False)
    stretched = rig.joints[sizes[:, 0] > _MAX_ANISOTROPY * sizes[:, 2]]
    if len(stretched) and rig.clips:
        which = f"{len(stretched)} of {len(rig.joints)} joints of {name}, such as {rig.names[stretched[0]]},"
        warn(f"{which} have a scale that differs by axis, and clips will look different: apply it before the export")


def _warn_of_lying_clips(a: Shape, rig: Rig, weights: SkinWeights, up: str, target: str) -> None:
    """Warn of clips in which the target will lie, since the source lies in its file and stays so in these clips."""
    if up in ("", "+y"):
        return
    top = int(rig.joints[np.asarray(weights.matrix.sum(axis=0)).ravel() > 0].min(initial=len(rig.names) - 1))
    lie = [clip.name for clip in rig.clips if points_at_start(clip, rig, top, axis_vector(up))[UP] < _LYING_COSINE]
    if lie:
        named = (
            "its clips"
            if len(lie) == len(rig.clips)
            else ", ".join(lie[:_MAX_LISTED]) + ", ..." * (len(lie) > _MAX_LISTED)
        )
        warn(f"{a.name} lies in its file, where {up} is up, and {target} will lie in {named}: export it with y up")


def _matched_skeleton(
    source: Path, data: bytes, rig: Rig, weights: SkinWeights, maps: MapPair
) -> tuple[Rig, SkinWeights]:
    """The skeleton, with its weights, of what was fitted; of all without a fit. Warns of joints and clips that are left out.

    `InputError` if what was fitted has no skeleton.
    """
    repaired = getattr(maps.match.source_fit, "repaired", None) if maps.match is not None else None
    if repaired is None or repaired.original.is_cloud:
        return rig, weights
    fitted = np.zeros(maps.source.V, bool)
    fitted[repaired.original.faces[repaired.kept_face]] = True
    used = gltf.parse_document(source, data, "skin makes", lambda document: find_skins(document, fitted))
    used |= np.asarray(weights.matrix[fitted].sum(axis=0)).ravel() > 0
    if not used.any():
        hint = "choose other parts, see `meshmatch info`"
        raise InputError(f"what was matched of {maps.source.name} has no skeleton", hint)
    kept = rig.nodes_around(used)
    columns = np.flatnonzero(kept[rig.joints])
    found = rig.restricted_to(kept)
    n_joints, n_clips = len(rig.joints) - len(columns), len(rig.clips) - len(found.clips)
    if not n_joints:
        return rig, weights
    joints, clips = (f"{n} {what}{'s' if n > 1 else ''}" for n, what in ((n_joints, "joint"), (n_clips, "clip")))
    what = f"{joints} and {clips}" if n_clips else joints
    warn(f"{what} of {maps.source.name} are of other figures than the one that was matched, and left out")
    return found, SkinWeights(csr_array(weights.matrix[:, columns]), tuple(weights.names[k] for k in columns))


def _refuse_copies(target: Shape, forward: VertexMap) -> None:
    """Raise `InputError` if the scene contains copies of the matched figure: all would follow the skeleton in one of them.

    Two meshes in one place, such as a body and an outline drawn around it, are no copies.
    """
    counts = [count for _, count in target.meshes]
    if len(counts) < 2 or sum(counts) != target.V:
        return
    mesh = np.repeat(np.arange(len(counts)), counts)
    original = counterparts(target, ~np.isin(mesh, mesh[forward.index]))
    copied = original >= 0
    if not copied.any():
        return
    figure, copy = target.verts[original[copied]], target.verts[copied]
    if np.linalg.norm(figure - copy, axis=1).mean() > _COPY_DISTANCE * np.linalg.norm(np.ptp(figure, axis=0)):
        hint = "export it once; copies of what comes out move alike"
        raise InputError(f"{target.name} draws one figure several times, which one skeleton cannot move", hint)


def transfer_rig(source: str | Path, target: ShapeLike, match: MapLike = None, *, pose: Pose = "rest") -> RiggedResult:
    """Transfer the skeleton, skin weights and animation clips of the source to the target.

    Joints follow the skin around them. Stray weights, holes and discontinuities in the weights are removed. Clips keep the
    rotations of the source, so that a target in any pose can play them; their translations are scaled, and feet that hang
    from the root stay attached to the legs.

    Parameters
    ----------
    source
        A rigged .glb, .gltf or .vrm, or a file that Blender reads.
    target
        The shape that receives the rig. A .glb, .gltf or .vrm keeps everything but its own skeleton. A shape from another
        format is turned upright by the skeleton, and keeps its texture or single color.
    match
        As in `find_maps`.
    pose
        Pose of the target in the file: its own ("rest"), or that of the source ("source").

    Returns
    -------
    RiggedResult
        The rigged target; ``save("rigged.glb")`` writes it.

    Raises
    ------
    MeshmatchError
        The source has no skeleton, or the target contains copies of a figure; or as for `find_maps`.

    Examples
    --------
    >>> result = meshmatch.transfer_rig("soldier.glb", "templates/samples/climber.ply")
    >>> result.save("rigged.glb")
    """
    if pose not in get_args(Pose):
        raise OptionError(f"invalid pose {pose!r}", f"choose one of {', '.join(get_args(Pose))}")
    source = as_path(source)
    source_shape = load_shape(source)
    sqrt_area_frame(source_shape)  # refuses a skeleton that collapses its skin, from which no joint can be placed
    if source.suffix.lower() not in gltf.SUFFIXES:
        raise InputError(f"{source_shape.name} has no skeleton", f"rigs come in {', '.join(gltf.SUFFIXES)}")
    source_data = read_bytes(source)
    rig, weights = read_rig(source, source_data), load_weights(source, source_shape)
    if n_constraints := gltf.parse_document(
        source, source_data, "scene makes", lambda doc: gltf_vrm.springs_and_constraints(doc.json)
    ):
        what = (
            "a spring or constraint, which is"
            if n_constraints == 1
            else f"{n_constraints} springs and constraints, which are"
        )
        warn(f"{source_shape.name} has {what} not transferred")
    _warn_of_stretched_joints(source_shape.name, rig)
    target_shape = as_shape(target, "target")
    path, data, in_gltf = as_gltf_scene(target, target_shape)
    rigid_groups = gltf.parse_document(path, data, "scene makes", find_rigid_groups)
    maps = find_maps(source_shape, target_shape, match)
    rig, weights = _matched_skeleton(source, source_data, rig, weights, maps)
    kept_figures = gltf.parse_document(
        path, data, "scene makes", lambda document: find_separate_figures(document, maps.forward.index)
    )
    if kept_figures:
        keeps = "keeps its" if len(kept_figures) == 1 else "keep their"
        warn(
            f"{', '.join(kept_figures.values())} of {target_shape.name or 'the target'} {keeps} own skeleton, "
            "apart from what was matched"
        )
    else:
        _refuse_copies(target_shape, maps.forward)
    _warn_of_lying_clips(source_shape, rig, weights, maps.forward.source_up, target_shape.name or "the target")
    with thread_limit(1):
        points, share = maps.forward.points(target_shape), vertex_weights(source_shape, maps)
        turn = np.eye(3) if in_gltf else rotation_to_upright(source_shape, points, share)
        ground = float((target_shape.verts[target_shape.valid] @ turn.T)[:, UP].min())
        carried = transfer_skeleton(rig, weights.matrix, source_shape, points @ turn.T, share, ground)
        pulled_weights = pull_weights(maps.backward, weights.matrix, INFLUENCES)
        unknown = find_uncovered(target_shape, points, source_shape.faces)
        target_weights = make_rigid(clean_weights(pulled_weights, target_shape, INFLUENCES, unknown), rigid_groups)
        standing, posed = carried.bind, carried.source_pose
        standing = posed if pose == "source" else replace(standing, clips=standing_clips(standing, posed))
        binding = Binding(standing, carried.bind.worlds(), *joint_table(target_weights), turn)
        glb, replaced = gltf.parse_document(
            path, data, "scene makes", lambda document: with_skeleton(document, binding, kept_figures)
        )
    before, after = (np.asarray(each.sum(axis=0)).ravel() > 0 for each in (weights.matrix, target_weights))
    unused = tuple(weights.names[joint] for joint in np.flatnonzero(before & ~after))
    skin = SkinWeights(target_weights, weights.names)
    original = as_path(target) if isinstance(target, str | Path) else None
    glb, lost = add_appearance(glb, original, target_shape)
    output = record_source_mesh(glb, target_shape)
    return RiggedResult(standing, skin, unused, replaced.joints, replaced.clips, maps, output, source, original, lost)
