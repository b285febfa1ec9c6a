"""`advsearch import`, which describes what advsearch reads from a mesh or scene file,
and `advsearch import-3db`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import advsearch
from advsearch.cli import output
from advsearch.cli.main import argument, command
from advsearch.cli.output import open_answer_progress
from advsearch.errors import InputError
from advsearch.files import MESHES, join_alternatives
from advsearch.runs.summary import read_result

if TYPE_CHECKING:
    from advsearch.scene.importing.scenes import FileContents
    from advsearch.scene.mitsuba_backend.scene_files import PluginContents

VIEWS = 4  # number of views in the picture of an object
SIDE = 192  # width and height of each view in pixels
# The description of a file: as a mapping for JSON, and as lines of text.
Understood = tuple[dict[str, Any], list[str]]


@command(
    argument(
        "file",
        metavar="FILE",
        help=f"a {join_alternatives(MESHES)} file, or an .xml file of Mitsuba",
    ),
    argument(
        "--out",
        metavar="FILE",
        help="picture to write of the contents, from four sides (.png)",
    ),
    output.add_json_flag,
    more=". Nothing is written but the picture",
    examples=(
        "import mug.obj",
        "import room.glb --json",
        "import room.glb --out room.png",
        "import box.xml --json",
    ),
)
def file(args: argparse.Namespace) -> int:
    """Print what advsearch reads from a mesh or scene file, and return the exit status.

    With `--out`, a picture of it is rendered, too.

    Raises:
        InputError: the file for the picture is no .png file.
    """
    out = None if args.out is None else Path(args.out)
    if out is not None and out.suffix.lower() != ".png":
        raise InputError(f"--out: expected the name of a .png file, got {args.out}")
    with open_answer_progress():
        facts, lines = _describe_and_render_file(args.file, out)
    facts = {"command": "import", "file": args.file, **facts, "out": args.out}
    return output.print_answer(args.json, facts, "\n".join(lines))


def _describe_and_render_file(file: str, out: Path | None) -> Understood:
    """Describe what advsearch reads from a file, and render it if `out` is given.

    Args:
        file: path of the file, as the user wrote it.
        out: file of the picture; None renders none.
    """
    # late, so that --help answers at once
    from advsearch.scene.importing.scenes import MITSUBA_SUFFIX, read_file_contents

    if Path(file).suffix.lower() == MITSUBA_SUFFIX:
        return _describe_mitsuba_file(file, out)
    contents = read_file_contents(Path(file))
    understood = _describe_mesh_file(file, contents)
    if out is not None:
        scene = advsearch.load_scene(contents.object)
        advsearch.render(scene, around=VIEWS, resolution=SIDE).save(out)
    return understood


def _describe_mesh_file(file: str, contents: FileContents) -> Understood:
    """Return what the file of a mesh contains: facts for JSON, and lines of text.

    Args:
        file: path of the file, as the user wrote it.
        contents: the object, nodes, lights and cameras in it.
    """
    mesh_object = contents.object
    motions = _list_motions(mesh_object.mesh.rig)
    slow_features = _explain_slow_features(mesh_object)  # a sentence for each
    facts: dict[str, Any] = {
        **_describe_object(mesh_object),
        "materials": _list_materials(mesh_object),
        "nodes": list(map(_describe_node, contents.nodes)),
        "lights": list(contents.lights),
        "cameras": list(contents.cameras),
        **motions,
        "slow": slow_features,
        "warnings": list(mesh_object.warnings),
    }
    lines = [_format_mesh_summary(file, facts)]
    if contents.nodes:
        lines += _format_nodes(file, contents.nodes)
    lines += _format_names(_name_kinds_of_mesh_file(contents, motions))
    lines += [f"Note: {note}" for note in (*mesh_object.warnings, *slow_features)]
    return facts, lines


def _list_materials(mesh_object: Any) -> list[dict[str, Any]]:
    """Return the name and the number of triangles of each material, for JSON."""
    return [
        {"name": name, "triangles": len(faces)}
        for name, faces in mesh_object.mesh.materials.items()
    ]


def _format_mesh_summary(file: str, facts: Mapping[str, Any]) -> str:
    """Return a line with the size and orientation of the object in a file."""
    width, height = facts["texture"]
    return (
        f"{file}: {facts['triangles']:,} triangles, a texture of {width} x {height}, "
        f"{facts['up']} up, front {facts['front']}"
    )


def _name_kinds_of_mesh_file(
    contents: FileContents, motions: Mapping[str, list[str]]
) -> dict[str, Iterable[str]]:
    """Return the names in the file of a mesh, by kinds that say how they are used.

    Args:
        contents: the object, lights and cameras in it.
        motions: names of its clips, joints and morph targets.
    """
    return {
        "materials (--control 'texture={materials: [NAME]}')": (
            contents.object.mesh.materials
        ),
        "lights": contents.lights,
        "cameras (--camera NAME)": contents.cameras,
        "clips (--control 'body={clip: NAME, time: [0, 1]}')": motions["clips"],
        "joints (--control 'body={NAME.x: [-30, 30]}')": motions["joints"],
        "morph targets (--control 'body={NAME.weight: [0, 1]}')": motions["targets"],
    }


def _format_names(names_by_kind: Mapping[str, Iterable[str]]) -> list[str]:
    """Return a line for each kind of which there are names."""
    return [
        f"{kind}: {', '.join(names)}" for kind, names in names_by_kind.items() if names
    ]


def _describe_node(node: Any) -> dict[str, Any]:
    """Return names and size of a node, for JSON."""
    return {
        "name": node.name,
        "mesh": node.mesh_name,
        "triangles": node.triangles,
        "size": list(node.size),
    }


def _describe_object(mesh_object: Any) -> dict[str, Any]:
    """Return size and orientation of an object, for JSON."""
    height, width = mesh_object.base_color.shape[:2]
    up = mesh_object.up
    front = mesh_object.front
    return {
        "triangles": len(mesh_object.mesh.faces),
        "texture": [width, height],
        "up": None if up is None else up.axis,
        "front": None if front is None else front.axis,
    }


def _list_motions(rig: Any) -> dict[str, list[str]]:
    """Return the names of the clips, joints and morph targets of a rig; empty lists
    without a rig.

    Each joint has parameters NAME.x, NAME.y and NAME.z, and each target NAME.weight.
    """
    if rig is None:
        return {"clips": [], "joints": [], "targets": []}
    joints = [name.removesuffix(".x") for name in rig.defaults if name.endswith(".x")]
    targets = [
        name.removesuffix(".weight")
        for name in rig.defaults
        if name.endswith(".weight")
    ]
    return {"clips": list(rig.clips), "joints": joints, "targets": targets}


def _explain_slow_features(mesh_object: Any) -> list[str]:
    """Return a sentence about features that make gradients slow, in a list; an empty
    list without such features.
    """
    features = {
        "what it lets light through": mesh_object.opacity,
        "its normal map": mesh_object.normal_map,
        "its emission": mesh_object.emission,
    }
    names = [name for name, feature in features.items() if feature is not None]
    if not names:
        return []
    return [
        f"slow: for {join_alternatives(names, 'and')}, controls that move outlines "
        "(pose, camera, geometry) are differentiated by differences, which takes "
        "several renders a step; textures and light are not slower"
    ]


def _format_nodes(file: str, nodes: Sequence[Any]) -> list[str]:
    """Return lines with a table of the nodes of a file, and examples of their use.

    Args:
        file: path of the file, as the user wrote it.
        nodes: the nodes, at least one.
    """
    rows = [["node", "in controls", "", "size"], *map(_make_node_row, nodes)]
    lines = [
        output.align_columns(rows),
        "One of them as the object, the rest around it: --object "
        f"'{file}#{nodes[-1].name}'",
    ]
    if len(nodes) > 1:
        lines.append(
            f"Another one moves with it: --control pose,pose:{nodes[0].mesh_name}"
        )
    return lines


def _make_node_row(node: Any) -> list[str]:
    """Return the row of a node in the table of nodes."""
    size = " x ".join(f"{length:.3g}" for length in node.size)
    return [node.name, node.mesh_name, f"{node.triangles:,} triangles", size]


def _describe_mitsuba_file(file: str, out: Path | None) -> Understood:
    """Describe what advsearch reads from a Mitsuba file, and render it if `out` is
    given.

    The first shape that is no light is loaded as the object.

    Args:
        file: path of the file, as the user wrote it.
        out: file of the picture; None renders none.

    Returns:
        What is in the file, for JSON; and the lines of the text.

    Raises:
        InputError: an image is requested, but no shape can be the object.
    """
    # late, so that --help answers at once
    from advsearch.scene.mitsuba_backend.scene_files import read_contents

    contents = read_contents(Path(file))
    warnings = _load_mitsuba_object(file, contents, out)
    # Shapes that advsearch renders but cannot change, with the reason.
    unchanged_shapes = dict(contents.unchanged)
    names_by_kind = _name_kinds_of_mitsuba_file(contents, unchanged_shapes)
    lines = [f"{file}: a Mitsuba scene", *_format_names(names_by_kind)]
    lines += _format_object_flags(file, contents.objects)
    lines += [f"Note: {warning}" for warning in warnings]
    facts = {
        **names_by_kind,
        "kept": unchanged_shapes,  # from shape to reason
        "warnings": list(warnings),
    }
    return facts, lines


def _name_kinds_of_mitsuba_file(
    contents: PluginContents, unchanged_shapes: Mapping[str, str]
) -> dict[str, list[str]]:
    """Return the names in a Mitsuba file by their kind.

    Args:
        contents: the shapes, lights and cameras in it.
        unchanged_shapes: shapes that advsearch renders but cannot change, with the
            reason, which is a part of the text here.
    """
    return {
        "objects": list(contents.objects),
        "kept": [f"{name} ({reason})" for name, reason in unchanged_shapes.items()],
        "lights": list(contents.lights),
        "cameras": list(contents.cameras),
    }


def _format_object_flags(file: str, object_names: Sequence[str]) -> list[str]:
    """Return a line with flags that choose a shape; no line if there are no shapes."""
    if not object_names:
        return []
    return [
        f"One of them as the object, the rest around it: --scene {file} "
        f"--object {object_names[-1]}"
    ]


def _load_mitsuba_object(
    file: str, contents: PluginContents, out: Path | None
) -> tuple[str, ...]:
    """Load a shape of a Mitsuba file, render it if `out` is given; return the warnings.

    Args:
        file: path of the file, as the user wrote it.
        contents: the shapes and lights in the file.
        out: file of the picture; None renders none.

    Raises:
        InputError: an image is requested, but no shape can be the object.
    """
    if not contents.objects and out is not None:
        raise InputError(
            f"{file}: no shape of it can be the object, so that it cannot "
            "be pictured; leave --out out"
        )
    if not contents.objects:
        return ()
    scene = advsearch.load_scene(_choose_object_shape(contents), scene=file)
    warnings = scene.description.object.warnings
    if out is not None:
        # one view, as large as the four of a mesh file together
        advsearch.render(scene, resolution=2 * SIDE).save(out)
    return warnings


def _choose_object_shape(contents: PluginContents) -> str:
    """Return the first shape of a Mitsuba file that is no light; the first shape if all
    are lights.
    """
    for name in contents.objects:
        if name not in contents.lights:
            return name
    return contents.objects[0]


def _describe(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Read details.log, class_maps.json and images/ of 3DB into a run: rows, small "
        "pictures, a page."
    )


@command(
    _describe,
    argument("folder", metavar="FOLDER", help="folder that 3DB wrote"),
    argument("--run", help="name or folder of the run (default: runs/FOLDER-3db-NNN)"),
    argument(
        "--overwrite", action="store_true", help="replace a run that exists already"
    ),
    output.add_json_flag,
)
def threedb(args: argparse.Namespace) -> int:
    """Make a run of a folder that 3DB wrote, and return the exit status."""
    from advsearch.questions.sweep.result import import_threedb  # takes seconds

    path = import_threedb(Path(args.folder), args.run, overwrite=args.overwrite)
    if args.json:
        output.print_json(read_result(path).to_dict())
    else:
        outcome = read_result(path).outcome_summary
        print(f"{path}: {outcome}; {path / 'report.html'} shows it")
    return 0
