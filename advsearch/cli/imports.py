"""`advsearch import`: what is understood of a mesh or scene file, before anything is
searched; and `import-3db`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import advsearch
from advsearch.cli import output
from advsearch.cli.main import argument, command
from advsearch.cli.output import at_work
from advsearch.errors import InputError
from advsearch.files import MESHES, either
from advsearch.runs.summary import read_result

if TYPE_CHECKING:
    from advsearch.scene.importing.scenes import Contents

VIEWS = 4  # views of the picture, and the side of each in pixels
SIDE = 192
# what is understood of a file, as JSON and in lines
Understood = tuple[dict[str, Any], list[str]]


@command(
    argument(
        "file",
        metavar="FILE",
        help=f"a {either(MESHES)} file, or an .xml file of Mitsuba",
    ),
    argument(
        "--out",
        metavar="FILE",
        help="a picture of all that is in it, from four sides (.png)",
    ),
    output.add_flags,
    more=". Nothing is written but the picture",
    examples=(
        "import mug.obj",
        "import room.glb --json",
        "import room.glb --out room.png",
        "import box.xml --json",
    ),
)
def file(args: argparse.Namespace) -> int:
    out = None if args.out is None else Path(args.out)
    if out is not None and out.suffix.lower() != ".png":
        raise InputError(f"--out: expected the name of a .png file, got {args.out}")
    with at_work(as_json=True, quiet=False):
        # late: another thing has this name here
        from advsearch.scene.importing.scenes import MITSUBA_SUFFIX, contents

        if Path(args.file).suffix.lower() == MITSUBA_SUFFIX:
            facts, lines = _mitsuba_file(args.file, out)
        else:
            inside = contents(Path(args.file))
            facts, lines = _mesh_file(args.file, inside)
            if out is not None:
                advsearch.render(
                    advsearch.load_scene(inside.object), around=VIEWS, resolution=SIDE
                ).save(out)
    facts = {"command": "import", "file": args.file, **facts, "out": args.out}
    return output.say(args.json, facts, "\n".join(lines))


def _mesh_file(file: str, inside: Contents) -> Understood:
    whole = inside.object
    nodes = inside.nodes
    rig = inside.object.mesh.rig
    materials = {name: len(faces) for name, faces in whole.mesh.materials.items()}
    width, height = whole.base_color.shape[1::-1]
    up = None if whole.up is None else whole.up.axis
    front = None if whole.front is None else whole.front.axis
    clips, moved = (
        (list(rig.clips), list(rig.defaults)) if rig is not None else ([], [])
    )
    joints = [name.removesuffix(".x") for name in moved if name.endswith(".x")]
    targets = [
        name.removesuffix(".weight") for name in moved if name.endswith(".weight")
    ]
    features = {
        "what it lets light through": whole.opacity,
        "its normal map": whole.normal_map,
    }
    features["its emission"] = whole.emission
    held = [name for name, feature in features.items() if feature is not None]
    slow = held and [
        f"slow: for {either(held, 'and')}, controls that move outlines (pose, camera, "
        "geometry) are differentiated by "
        "differences, which takes several renders a step; textures and light are not "
        "slower"
    ]
    facts = {
        "triangles": len(whole.mesh.faces),
        "texture": [width, height],
        "up": up,
        "front": front,
        "materials": [
            {"name": name, "triangles": count} for name, count in materials.items()
        ],
        "nodes": [
            {
                "name": n.name,
                "mesh": n.mesh_name,
                "triangles": n.triangles,
                "size": list(n.size),
            }
            for n in nodes
        ],
        "lights": list(inside.lights),
        "cameras": list(inside.cameras),
        **{"clips": clips, "joints": joints, "targets": targets},
        "slow": slow,
        "warnings": list(whole.warnings),
    }
    lines = [
        f"{file}: {len(whole.mesh.faces):,} triangles, a texture of {width} x "
        f"{height}, {up} up, front {front}"
    ]
    if nodes:
        sizes = [" x ".join(f"{side:.3g}" for side in node.size) for node in nodes]
        rows = [
            [n.name, n.mesh_name, f"{n.triangles:,} triangles", size]
            for n, size in zip(nodes, sizes, strict=True)
        ]
        lines.append(output.aligned([["node", "in controls", "", "size"], *rows]))
        lines.append(
            "One of them as the object, the rest around it: --object "
            f"'{file}#{nodes[-1].name}'"
        )
        if len(nodes) > 1:
            lines.append(
                f"Another one moves with it: --control pose,pose:{nodes[0].mesh_name}"
            )
    listed = {
        "materials (--control 'texture={materials: [NAME]}')": materials,
        "lights": inside.lights,
        "cameras (--camera NAME)": inside.cameras,
        "clips (--control 'body={clip: NAME, time: [0, 1]}')": clips,
        "joints (--control 'body={NAME.x: [-30, 30]}')": joints,
        "morph targets (--control 'body={NAME.weight: [0, 1]}')": targets,
    }
    lines += [f"{what}: {', '.join(names)}" for what, names in listed.items() if names]
    return facts, lines + [f"Note: {note}" for note in (*whole.warnings, *slow)]


def _mitsuba_file(file: str, out: Path | None) -> Understood:
    # late: another thing has this name here
    from advsearch.scene.mitsuba_backend.scene_files import read_contents

    inside = read_contents(Path(file))
    warnings: tuple[str, ...] = ()
    if inside.objects:
        plain = next(
            (name for name in inside.objects if name not in inside.lights),
            inside.objects[0],
        )
        scene = advsearch.load_scene(plain, scene=file)
        warnings = scene.description.object.warnings
        if out is not None:
            advsearch.render(scene, resolution=2 * SIDE).save(out)
    elif out is not None:
        raise InputError(
            f"{file}: no shape of it can be the object, so that it cannot "
            "be pictured; leave --out out"
        )
    kept = dict(inside.unchanged)
    listed = {
        "objects": list(inside.objects),
        "kept": [f"{name} ({why})" for name, why in kept.items()],
    }
    listed |= {"lights": list(inside.lights), "cameras": list(inside.cameras)}
    lines = [f"{file}: a Mitsuba scene"]
    lines += [f"{what}: {', '.join(names)}" for what, names in listed.items() if names]
    if inside.objects:
        lines.append(
            f"One of them as the object, the rest around it: --scene {file} "
            f"--object {inside.objects[-1]}"
        )
    lines += [f"Note: {warning}" for warning in warnings]
    return {**listed, "kept": kept, "warnings": list(warnings)}, lines


def _describe(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Read details.log, class_maps.json and images/ of 3DB into a run: rows, small "
        "pictures, a page."
    )


@command(
    _describe,
    argument("folder", metavar="FOLDER", help="what 3DB wrote"),
    argument("--run", help="name or folder of the run (default: runs/FOLDER-3db-NNN)"),
    argument("--overwrite", action="store_true", help="replace the run that is there"),
    output.add_flags,
)
def threedb(args: argparse.Namespace) -> int:
    from advsearch.questions.sweep.result import import_threedb  # takes seconds

    path = import_threedb(Path(args.folder), args.run, overwrite=args.overwrite)
    if args.json:
        output.print_json(read_result(path).to_dict())
    else:
        print(f"{path}: {read_result(path).brief}; {path / 'report.html'} shows it")
    return 0
