"""Files of objects and cameras that are not read: what they are, and the program and command that convert them."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

BLENDER_READS = {
    "an FBX model": ("bpy.ops.import_scene.fbx", (".fbx",)),
    "an Alembic scene": ("bpy.ops.wm.alembic_import", (".abc",)),
}
SPLATS = (
    "has no surface; train one that yields a mesh (2D Gaussian Splatting's render.py writes fuse_post.ply), name that"
)
POINTS = (
    "has no surface; make one (in Python open3d.geometry.TriangleMesh.create_from_point_cloud_poisson), name its .ply"
)
UNPACK = "unpack it, and name the mesh in it"
ELSEWHERE = "open it in that program and export glTF (.glb)"
ASSIMP = "make an .obj of it, with assimp (Open Asset Import Library): assimp export {file} {obj}"
SAID = {
    "a COLLADA model": (ASSIMP, (".dae", ".zae")),
    "a 3MF model": (ASSIMP, (".3mf",)),
    "a 3D Studio model": (ASSIMP, (".3ds",)),
    "an OFF mesh": (ASSIMP, (".off",)),
    "an X3D or VRML scene": (ASSIMP, (".x3d", ".wrl")),
    "a LightWave model": (ASSIMP, (".lwo",)),
    "a CAD model without triangles": (
        "mesh it, with Gmsh: gmsh {file} -2 -o {stl}",
        (".step", ".stp", ".iges", ".igs", ".brep"),
    ),
    "a building (IFC)": ("make glTF of it: IfcConvert {file} {glb}", (".ifc",)),
    "a tile of 3D Tiles": ("take its glTF out: npx 3d-tiles-tools b3dmToGlb -i {file} -o {glb}", (".b3dm",)),
    "a model of Gaussian splats": (SPLATS, (".splat", ".ksplat", ".spz")),
    "a cloud of points": (POINTS, (".las", ".laz", ".pcd", ".e57", ".xyz", ".pts")),
    "an archive": (UNPACK, (".zip", ".gz", ".7z", ".rar", ".tar", ".tgz", ".gltfz")),
    "a file of Maya's": (ELSEWHERE, (".ma", ".mb")),
    "a file of 3ds Max's": (ELSEWHERE, (".max",)),
    "a file of Cinema 4D's": (ELSEWHERE, (".c4d",)),
    "a file of SketchUp's": (ELSEWHERE, (".skp",)),
    "NumPy's arrays": ("write the mesh, as in trimesh.Trimesh(vertices, faces).export('mesh.ply')", (".npz", ".npy")),
    "a picture": (
        "an object is a mesh; `environment` takes .hdr and .exr",
        (".png", ".jpg", ".jpeg", ".webp", ".hdr", ".exr"),
    ),
}
CAMERAS = {
    ".bin": "COLMAP's binary cameras: write them as text, colmap model_converter --input_path FOLDER --output_path "
    "FOLDER --output_type TXT, and give cameras.txt",
    ".npz": "NumPy's arrays: write them as JSON, with image_width, image_height, camera_matrix and "
    "distortion_coefficients (numpy.ndarray.tolist)",
}
CAMERAS |= {".npy": CAMERAS[".npz"], ".pkl": CAMERAS[".npz"].replace("NumPy's arrays", "a pickle, which may run code")}
"""What files of cameras are that are not read, and what to do."""


def advice(path: Path) -> str | None:
    """Return what a file is by its ending, and what to do with it; None where that is not known.

    The rest of a sentence: ``"an FBX model: make glTF of it, with Blender: blender -b ..."``.
    """
    ending, name = path.suffix.lower(), path.name
    for what, (operator, endings) in BLENDER_READS.items():
        if ending in endings:
            steps = f"bpy.ops.wm.read_factory_settings(use_empty=True); {operator}(filepath={json.dumps(name)})"
            script = f"import bpy; {steps}; bpy.ops.export_scene.gltf(filepath={json.dumps(f'{path.stem}.glb')})"
            return f"{what}: make glTF of it, with Blender: blender -b --python-expr {shlex.quote(script)}"
    if ending == ".bin":
        beside = sorted(other.name for other in path.parent.glob("*.gltf"))[:1] if path.parent.is_dir() else []
        return f"a buffer, as a .gltf file has beside it: name that file{f', {beside[0]}' if beside else ''}"
    names = {kind: shlex.quote(f"{path.stem}.{kind}") for kind in ("obj", "stl", "glb")}
    said = ((what, said) for what, (said, endings) in SAID.items() if ending in endings)
    return next((f"{what}: {how.format(file=shlex.quote(name), **names)}" for what, how in said), None)
