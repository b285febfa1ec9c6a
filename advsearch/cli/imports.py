"""`advsearch import`: what is understood of a mesh or scene file, before anything is searched; and `import-3db`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import advsearch
from advsearch.cli import output
from advsearch.cli.commands import Command
from advsearch.cli.output import at_work
from advsearch.errors import InputError
from advsearch.files import MESHES, either
from advsearch.runs.summary import read_result

if TYPE_CHECKING:
    from advsearch.scene.assets import ObjectAsset
    from advsearch.scene.importing.scenes import Contents

VIEWS, SIDE = 4, 192
"""Views of the picture, and the side of each in pixels."""


def _import_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help=f"a {either(MESHES)} file, or an .xml file of Mitsuba")
    parser.add_argument("--out", metavar="FILE", help="a picture of all that is in it, from four sides (.png)")
    output.add_flags(parser)


def _import(args: argparse.Namespace) -> int:
    out = None if args.out is None else Path(args.out)
    if out is not None and out.suffix.lower() != ".png":
        raise InputError(f"--out: expected the name of a .png file, got {args.out}")
    with at_work(as_json=True, quiet=False):
        # late: another thing has this name here
        from advsearch.scene.importing.scenes import MITSUBA_FILE, contents

        if Path(args.file).suffix.lower() == MITSUBA_FILE:
            tell = _mitsuba(args, out)
        else:
            found = contents(Path(args.file))
            tell = partial(_tell_mesh_file, args, found)
            if out is not None:
                advsearch.render(advsearch.load_scene(found.object), around=VIEWS, resolution=SIDE).save(out)
    return tell()  # standard output is kept clean until here


def _tell_mesh_file(args: argparse.Namespace, found: Contents) -> int:
    whole = found.object
    facts = {
        "triangles": len(whole.mesh.faces),
        "texture": list(whole.base_color.shape[1::-1]),
        "up": None if whole.up is None else whole.up.axis,
    }
    materials = {name: len(faces) for name, faces in whole.mesh.materials.items()}
    slow = _slow(whole)
    nodes = [
        {"name": one.name, "mesh": one.mesh, "triangles": one.triangles, "size": list(one.size)} for one in found.nodes
    ]
    rig = whole.mesh.rig
    moves: dict[str, list[str]] = {"clips": [], "joints": [], "targets": []}
    if rig is not None:
        moves["clips"] = list(rig.clips)
        moves["joints"] = [name.removesuffix(".x") for name in rig.defaults if name.endswith(".x")]
        moves["targets"] = [name.removesuffix(".weight") for name in rig.defaults if name.endswith(".weight")]
    if args.json:
        told = {
            "file": args.file,
            **facts,
            "materials": [{"name": name, "triangles": count} for name, count in materials.items()],
            "nodes": nodes,
            "lights": list(found.lights),
            "cameras": list(found.cameras),
            **moves,
        }
        said = {"slow": slow, "warnings": list(whole.warnings), "out": args.out}
        output.print_json({"schema": 1, "command": "import", **told, **said})
        return 0
    width, height = whole.base_color.shape[1], whole.base_color.shape[0]
    print(f"{args.file}: {facts['triangles']:,} triangles, a texture of {width} x {height}, {facts['up']} up")
    if nodes:
        rows = [
            [one.name, one.mesh, f"{one.triangles:,} triangles", " x ".join(f"{side:.3g}" for side in one.size)]
            for one in found.nodes
        ]
        print(output.aligned([["node", "in controls", "", "size"], *rows]))
        print(f"One of them as the object, the rest around it: --object '{args.file}#{found.nodes[-1].name}'")
        if len(found.nodes) > 1:
            print(f"Another one moves with it: --control pose,pose:{found.nodes[0].mesh}")
    paint = "materials (--control 'texture={materials: [NAME]}')"
    turns, mixes = (
        "joints (--control 'body={NAME.x: [-30, 30]}')",
        "morph targets (--control 'body={NAME.weight: [0, 1]}')",
    )
    plays = "clips (--control 'body={clip: NAME, time: [0, 1]}')"
    listed = {paint: materials, "lights": found.lights, "cameras (--camera NAME)": found.cameras}
    listed |= {plays: moves["clips"], turns: moves["joints"], mixes: moves["targets"]}
    for what, names in listed.items():
        if names:
            print(f"{what}: {', '.join(names)}")
    for note in (*whole.warnings, *slow):
        print(f"Note: {note}")
    return 0


def _slow(whole: ObjectAsset) -> list[str]:
    """Return what of an object makes searches slower, and why."""
    features = {"what it lets light through": whole.opacity, "its normal map": whole.normal_map}
    features["its emission"] = whole.emission
    found = [name for name, one in features.items() if one is not None]
    if not found:
        return []
    *others, last = found
    named = f"{', '.join(others)} and {last}" if others else last
    return [
        f"slow: for {named}, controls that move outlines (pose, camera, geometry) are differentiated by differences, "
        "which takes several renders a step; textures and light are not slower"
    ]


def _mitsuba(args: argparse.Namespace, out: Path | None) -> Callable[[], int]:
    """Read and picture, as its first camera sees it, a Mitsuba scene; return what prints what was understood."""
    # late: another thing has this name here
    from advsearch.scene.mitsuba_backend.scene_files import contents

    found = contents(Path(args.file))
    warnings: tuple[str, ...] = ()
    if found.objects:
        plain = next((name for name in found.objects if name not in found.lights), found.objects[0])
        scene = advsearch.load_scene(plain, scene=args.file)
        warnings = scene.description.object.warnings
        if out is not None:
            advsearch.render(scene, resolution=2 * SIDE).save(out)
    elif out is not None:
        raise InputError(
            f"{args.file}: no shape of it can be the object, so that it cannot be pictured; leave --out out"
        )
    listed = {
        "objects": list(found.objects),
        "kept": dict(found.kept),
        "lights": list(found.lights),
        "cameras": list(found.cameras),
    }
    return partial(_tell_scene, args, listed, warnings)


def _tell_scene(args: argparse.Namespace, listed: Mapping[str, Any], warnings: Sequence[str]) -> int:
    """Print what was understood of a Mitsuba scene: names by what they are."""
    if args.json:
        told = {"file": args.file, **listed, "warnings": list(warnings), "out": args.out}
        output.print_json({"schema": 1, "command": "import", **told})
        return 0
    print(f"{args.file}: a Mitsuba scene")
    for what, names in listed.items():
        if names:
            shown = [f"{name} ({names[name]})" if isinstance(names, dict) else name for name in names]
            print(f"{what}: {', '.join(shown)}")
    if listed["objects"]:
        print(f"One of them as the object, the rest around it: --scene {args.file} --object {listed['objects'][-1]}")
    for warning in warnings:
        print(f"Note: {warning}")
    return 0


IMPORT = Command(
    _import_arguments,
    _import,
    ". Nothing is written but the picture",
    ("import mug.obj", "import room.glb --json", "import room.glb --out room.png", "import box.xml --json"),
)


def _threedb_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Read details.log, class_maps.json and images/ of 3DB into a run: rows, small pictures, a page."
    )
    parser.add_argument("folder", metavar="FOLDER", help="what 3DB wrote")
    parser.add_argument("--run", help="name or folder of the run (default: runs/FOLDER-3db-NNN)")
    parser.add_argument("--overwrite", action="store_true", help="replace the run that is there")
    output.add_flags(parser)


def _import_threedb(args: argparse.Namespace) -> int:
    from advsearch.questions.sweep.result import import_threedb  # takes seconds

    path = import_threedb(Path(args.folder), args.run, overwrite=args.overwrite)
    if args.json:
        output.print_json(read_result(path).to_dict())
    else:
        print(f"{path}: {read_result(path).brief}; {path / 'report.html'} shows it")
    return 0


IMPORT_3DB = Command(_threedb_arguments, _import_threedb)
