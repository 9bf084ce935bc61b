"""Commands that transfer attributes: ``transfer-color``, ``-labels``, ``-weights`` and ``-landmarks``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from typer import Option

import meshmatch
from meshmatch.cli.options import RuleOptions, RunOptions, grouped, optional, output_option
from meshmatch.cli.targets import Gather, to_targets
from meshmatch.cli.transfer_options import MapOptions, MapOptionsWithPairs, Picture, Source, Target, Transfer
from meshmatch.cli.user_messages import Json
from meshmatch.errors import InputError, OptionError, warn
from meshmatch.outputs import replace_on_success
from meshmatch.scalars import counted

On = Literal["vertices", "faces"]


@grouped
@to_targets("transfer_colors")
def transfer_color(
    *,
    source: Source,
    target: Target,
    output: Path = output_option(
        "FILE",
        "TGT with colors (.ply, .glb, .vrm, .obj, .off, .vtp or .vtk), or colors alone (.npy or .csv). With --values: TGT "
        "with the values (.ply, .vtp or .vtk), or values alone (.npy or .csv).",
    ),
    maps: MapOptions,
    rules: RuleOptions,
    run: RunOptions,
    values: Path | None = optional(
        "FILE", "Transfer these numbers instead of colors: a row per vertex of SRC (.npy, .csv, or a .vtp with arrays)."
    ),
    directions: bool = Option(
        False, "--directions", help="--values are directions, such as normals: rotate them with the surface."
    ),
    picture: Picture = None,
) -> Json:
    """Transfer vertex colors, or other numbers per vertex.

    Values are interpolated within the faces of SRC. The VALUE of --blank is a number, one number per column (1,0,0), or a
    color (#ff0000).
    """
    from meshmatch.shapes.dressed_files import warn_about_losses
    from meshmatch.transfer import value_files

    if directions and values is None:
        raise OptionError("--directions needs --values", "give the vectors with --values")
    transfer = Transfer(source, target, output, maps, run, picture)
    (value_files.check_color_suffix if values is None else value_files.check_values_suffix)(output)
    with transfer.outputs(values) as (temporary,):
        a = meshmatch.load_shape(source)
        given = None if values is None else value_files.load_values(values, a)
        here = value_files.linear_colors(a) if given is None else given.numbers
        columns = 1 if here.ndim == 1 else here.shape[1]
        rule = rules.rule(None if rules.blank is None else value_files.parse_blank(rules.blank, columns).tolist())
        if given is None:
            result = meshmatch.transfer_colors(a, target, transfer, rule=rule)
            result.writer(temporary, output)
        else:
            result = meshmatch.transfer_values(a, target, given.numbers, transfer, directions=directions, rule=rule)
            found = value_files.Values(result.data, given.names)
            warn_about_losses(target, output, value_files.save_values(temporary, found, result.maps.target, target))
    b = result.maps.target
    low = transfer.report_low(result.low, rule.minimum)
    what = "colors" if given is None else f"{columns} number{'s' if columns > 1 else ''} each"
    transfer.console.say(f"wrote {output}: {what} for the {b.V} vertices of {transfer.names[1]}")
    if picture is not None:
        from meshmatch.render.compose import compose_values
        from meshmatch.shapes.colors import linear_to_srgb_alpha, srgb_to_linear_alpha

        if given is None:
            shown = compose_values(
                (a, b), [linear_to_srgb_alpha(each)[:, :3] for each in (here, srgb_to_linear_alpha(result.data))]
            )
        else:
            title = given.names[0] if given.names else str(values and values.stem)
            title += "" if columns == 1 else f" (the first of {columns} numbers)"
            tables = [table if table.ndim == 1 else table[:, 0] for table in (here, result.data)]
            shown = compose_values((a, b), tables, title)
        transfer.draw(result.maps, shown)
    return transfer.record({"picture": picture, "columns": columns} | low, result.maps, float(result.confidence.mean()))


@grouped
@to_targets("transfer_labels")
def transfer_labels(
    *,
    source: Source,
    target: Target,
    output: Path = output_option("FILE", "Labels: .npy, .csv, .txt or .json, or TGT as .ply or .vtp."),
    labels: Path = Option(
        ..., metavar="FILE", help="An integer or a word per vertex or face of SRC: .npy, .csv, .txt or .json."
    ),
    maps: MapOptions,
    rules: RuleOptions,
    run: RunOptions,
    on: On | None = Option(
        None, help="Whether --labels belong to vertices or faces. Default: decided by their number."
    ),
    to: On | None = Option(None, help="Whether to label vertices or faces of TGT. Default: as in --labels."),
    picture: Picture = None,
) -> Json:
    """Transfer labels of vertices or faces.

    Labels are chosen by vote and never averaged. The VALUE of --blank is a label, such as -1 or unknown; TGT also
    gets it where SRC has no label.
    """
    import numpy as np

    from meshmatch.transfer.label_files import check_labels_suffix, load_labels

    transfer = Transfer(source, target, output, maps, run, picture)
    rule = rules.rule(rules.blank)
    check_labels_suffix(output)
    with transfer.outputs(labels) as (temporary,):
        a = meshmatch.load_shape(source)
        given = load_labels(labels, a, on)
        result = meshmatch.transfer_labels(a, target, given, transfer, to=to, rule=rule)
        found = result.data
        result.writer(temporary, output)
    low = transfer.report_low(result.low, rule.minimum, found.on)
    used = len(np.unique(found.codes))
    transfer.console.say(
        f"wrote {output}: {used} different labels on the {len(found.codes)} {found.on} of {transfer.names[1]}"
    )
    if picture is not None:
        from meshmatch.render.compose import compose_labels

        names = [str(name) for name in given.names]
        codes = np.where(found.codes < len(names), found.codes, -1)  # the code of a blank follows those of the names
        faces = given.on == "faces", found.on == "faces"
        transfer.draw(result.maps, compose_labels((a, result.maps.target), (given.codes, codes), names, faces))
    record = {"picture": picture, "from": given.on, "to": found.on, "labels": used} | low
    return transfer.record(record, result.maps, float(result.maps.backward.confidence.mean()))


@grouped
@to_targets("transfer_weights")
def transfer_weights(
    *,
    source: Source,
    target: Target,
    output: Path = output_option("FILE", "Skin weights of TGT: .npz or .json."),
    maps: MapOptions,
    run: RunOptions,
    weights: Path | None = optional("FILE", "Skin weights of SRC: .npz, .json, .glb or .vrm. Default: those in SRC."),
    influences: int = Option(4, min=1, help="Maximum number of joints per vertex."),
    fill: bool = Option(False, "--fill", help="Replace weights of low confidence by those of their neighbours."),
    min_confidence: float = Option(0.3, min=0.0, max=1.0, help="Minimum confidence for weights to be trusted."),
    picture: Picture = None,
) -> Json:
    """Transfer skin weights.

    Weights are interpolated within the faces of SRC. Each vertex keeps the joints with the largest weights, which then sum
    to 1.
    """
    import numpy as np

    from meshmatch.shapes.formats.gltf import SUFFIXES as GLTF_SUFFIXES
    from meshmatch.transfer.weight_files import check_weights_suffix, load_weights

    transfer = Transfer(source, target, output, maps, run, picture)
    rule = meshmatch.ConfidenceRule(min_confidence, fill)
    if output.suffix.lower() in GLTF_SUFFIXES:
        raise OptionError(
            f"{output.name} needs a skeleton too", "use meshmatch transfer-rig, or end the name in .npz or .json"
        )
    check_weights_suffix(output)
    with transfer.outputs(weights) as (temporary,):
        a, b = meshmatch.load_shape(source), meshmatch.load_shape(target)
        if weights is None and source.suffix.lower() not in GLTF_SUFFIXES:
            raise InputError(f"{a.name} has no skin weights", "give them in a file: --weights weights.npz")
        given = load_weights(weights or source, a)
        result = meshmatch.transfer_weights(a, b, given, transfer, influences=influences, rule=rule)
        matrix = result.data.matrix
        result.writer(temporary, output)
    low = transfer.report_low(result.low, min_confidence)
    bare = int((np.diff(matrix.indptr) == 0).sum())
    if bare:
        transfer.console.warn(f"{bare} of the {b.V} vertices have no weights: no joint moves them on {a.name}")
    used = len(np.unique(matrix.indices))
    transfer.console.say(f"wrote {output}: weights of {used} joints for the {b.V} vertices of {transfer.names[1]}")
    if picture is not None:
        from meshmatch.render.compose import compose_labels
        from meshmatch.transfer.attributes import most_votes

        heaviest = most_votes(given.matrix), most_votes(matrix)
        transfer.draw(result.maps, compose_labels((a, b), heaviest, given.names))
    counts = {"picture": picture, "joints": len(given.names), "used_joints": used, "without_weights": bare}
    return transfer.record(counts | low, result.maps, float(result.confidence.mean()))


def _check_landmark_table(table: Path) -> None:
    from meshmatch.transfer.landmarks import check_table_suffix

    check_table_suffix(table)


def _landmark_table(table: Path, given: Mapping[str, Any], source: str, written: Mapping[str, Path]) -> str:
    """Write the landmarks of SRC and all targets as one table."""
    import numpy as np

    from meshmatch.collections.registered import mixed_units
    from meshmatch.shapes.landmark_files import mesh_space
    from meshmatch.transfer.landmarks import landmark_positions, load_landmarks, relative_size, save_specimens

    path = given["source"]
    own, _ = load_landmarks(given["landmarks"], meshmatch.load_shape(path), mesh_space(path))
    specimens = {source: own.points} | {name: landmark_positions(file) for name, file in written.items()}
    with replace_on_success(table) as temporary:
        save_specimens(temporary, specimens, own.names)
    sizes = {name: relative_size(points, own.points) for name, points in specimens.items()}
    if units := mixed_units(
        known := [name for name, size in sizes.items() if size > 0], [sizes[name] for name in known]
    ):
        warn(units)
    lost = {name: int(np.isnan(points).any(axis=1).sum()) for name, points in specimens.items()}
    missing = ", ".join(f"{count} of {name}" for name, count in lost.items() if count)
    message = f"wrote {table}: {len(own.names)} landmarks of {len(specimens)} specimens, {source} included"
    return message + (f"; missing are {missing}" if missing else "")


@grouped
@to_targets("transfer_landmarks", Gather(_check_landmark_table, _landmark_table))
def transfer_landmarks(
    *,
    source: Source,
    target: Target,
    output: Path = output_option("FILE", "Landmarks of TGT: .csv, .json, .pp, .fcsv, .mrk.json or .tps."),
    landmarks: Path = Option(
        ...,
        "--landmarks",
        metavar="FILE",
        help="Landmarks of SRC, as vertices or positions: .csv, .txt, .npy, .json, .pts, .tps, MeshLab's .pp, 3D Slicer's "
        ".fcsv and .mrk.json, Amira's .landmarkAscii, or Morphologika's .txt.",
    ),
    maps: MapOptionsWithPairs,
    run: RunOptions,
    min_confidence: float = Option(0.3, min=0.0, max=1.0, help="Landmarks below this confidence are missing on TGT."),
    table: Path | None = optional(
        "FILE",
        "With several targets, also write one table of all shapes, including SRC: .csv, .tps, Morphologika's .txt, or "
        ".npz.",
    ),
    picture: Picture = None,
) -> Json:
    """Transfer landmarks to points of another surface.

    Positions in --landmarks are moved to the nearest point of SRC. For each landmark, .csv and .json files contain its
    vertex, position, face with barycentric weights, and confidence; .pp, .fcsv and .mrk.json files its name and position;
    .tps files its position. Landmarks of low confidence, for example on a part that TGT lacks, are listed in a warning and
    missing in the output (NA in .tps). --min-confidence 0 keeps all of them.
    """
    import numpy as np

    from meshmatch.shapes.landmark_files import mesh_space
    from meshmatch.transfer.landmarks import check_landmarks_suffix, landmarks_with_warnings

    transfer = Transfer(source, target, output, maps, run, picture)
    console = transfer.console
    check_landmarks_suffix(output)
    with transfer.outputs(landmarks) as (temporary,):
        a = meshmatch.load_shape(source)
        given = landmarks_with_warnings(landmarks, a, mesh_space(source))
        result = meshmatch.transfer_landmarks(a, target, given, transfer, rule=meshmatch.ConfidenceRule(min_confidence))
        found, b = result.data, result.maps.target
        result.writer(temporary, output)
    low = np.flatnonzero(found.missing)
    if len(low):
        first_ones = [f"{found.names[k]} ({found.confidence[k]:.2f})" for k in low[:10].tolist()]
        more = f" and {len(low) - 10} more" if len(low) > 10 else ""
        listed = f"{', '.join(first_ones)}{more}"
        console.warn(f"{transfer.names[1]}: missing are landmarks of confidence below {min_confidence:g}: {listed}")
    console.say(f"wrote {output}: {counted(len(found.names) - len(low), 'landmark')} on {transfer.names[1]}")
    if picture is not None:
        from meshmatch.render.compose import compose_points

        there = ~found.missing
        transfer.draw(result.maps, compose_points((a, b), (given.points[there], found.points[there])))
    counts = {"landmarks": len(found.names), "min_confidence": min_confidence, "low_confidence": len(low)}
    return transfer.record({"picture": picture} | counts, result.maps, float(result.maps.forward.confidence.mean()))
