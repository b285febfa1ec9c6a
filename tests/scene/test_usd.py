"""OpenUSD files: what is read of them beside their twins in glTF, what is left out, and what is refused."""

import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import advsearch
from advsearch.errors import FileFormatError, InputError
from advsearch.scene.assets import ObjectAsset
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.glb import encode_glb
from advsearch.scene.importing import usd
from advsearch.scene.importing.objects import import_object
from advsearch.scene.importing.scenes import read_file_contents
from advsearch.scene.library import load_object
from advsearch.scene.parts import PointLamp, SpotLamp

needs_usd = pytest.mark.skipif(not usd.is_installed(), reason="usd-core is not installed: pip install 'advsearch[usd]'")
pytestmark = [pytest.mark.medium, needs_usd, pytest.mark.island("advsearch.scene.importing.usd")]
PREVIEW = """
    def Material "{name}" {{
        token outputs:surface.connect = </Root/{name}/surface.outputs:surface>
        def Shader "surface" {{
            uniform token info:id = "UsdPreviewSurface"
            token outputs:surface
{inputs}
        }}
        def Shader "st" {{
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }}
        def Shader "color" {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @{picture}@
            token inputs:wrapS = "repeat"
            token inputs:wrapT = "repeat"
            float2 inputs:st.connect = </Root/{name}/st.outputs:result>
            float3 outputs:rgb
            float outputs:r
            float outputs:g
            float outputs:a
        }}
    }}
"""


def preview(name: str = "paint", picture: str = "skin.png", **inputs: object) -> str:
    """A material with inputs: numbers, colours as tuples, or the output of the picture ("rgb")."""
    lines = []
    for key, value in inputs.items():
        kind = "color3f" if key.endswith("Color") else "normal3f" if key == "normal" else "float"
        if isinstance(value, str):
            lines.append(f"{kind} inputs:{key}.connect = </Root/{name}/color.outputs:{value}>")
        else:
            lines.append(f"{kind} inputs:{key} = {value}")
    return PREVIEW.format(name=name, picture=picture, inputs="\n".join(f"            {line}" for line in lines))


def stage(body: str, *, up: str = "Y", unit: float | None = 1.0, root: str = "Xform") -> str:
    """A file with a body in its root prim."""
    metres = "" if unit is None else f"    metersPerUnit = {unit}\n"
    head = f'#usda 1.0\n(\n    defaultPrim = "Root"\n{metres}    upAxis = "{up}"\n)\n'
    return f'{head}def {root} "Root"\n{{\n{body}\n}}\n'


def rows(values: Any) -> str:
    return "[" + ", ".join("(" + ", ".join(f"{one:.9g}" for one in row) + ")" for row in np.asarray(values)) + "]"


def mesh(
    points: Any, faces: Sequence[Sequence[int]], *, name: str = "thing", material: str = "", more: str = "", **own: Any
) -> str:
    """A prim of a mesh whose corners have their own values where there are `normals` and `st`."""
    bound = f"rel material:binding = </Root/{material}>" if material else ""
    corners = [corner for face in faces for corner in face]
    values = ""
    if "normals" in own:
        values += f'normal3f[] normals = {rows(own["normals"])} (interpolation = "{own.get("per", "vertex")}")\n'
    if "st" in own:
        values += f'texCoord2f[] primvars:st = {rows(own["st"])} (interpolation = "{own.get("per", "vertex")}")\n'
    return f"""
    def Mesh "{name}" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
        point3f[] points = {rows(points)}
        int[] faceVertexCounts = {[len(face) for face in faces]}
        int[] faceVertexIndices = {corners}
        uniform token subdivisionScheme = "{own.get("scheme", "none")}"
        {values}{bound}
        {more}
    }}
"""


CUBE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
SIDES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def y_up(vectors: Any) -> np.ndarray:
    x, y, z = np.asarray(vectors, np.float64).T
    return np.stack([x, z, -y], axis=1)


@pytest.fixture
def mug(tmp_path: Path) -> tuple[ObjectAsset, Path]:
    """The bundled mug, and a folder with its twin in glTF and its texture."""
    made = load_object("mug")
    (tmp_path / "twin.glb").write_bytes(encode_glb([made]))
    picture = Image.fromarray(np.uint8(np.clip(made.base_color, 0, 1) * 255 + 0.5))
    picture.save(tmp_path / "skin.png")
    return made, tmp_path


def of_mug(made: ObjectAsset, *, up: str = "Y", unit: float = 1.0, **more: Any) -> str:
    """The mug in USD, in an axis and a unit."""
    turned = y_up if up == "Y" else np.asarray
    body = mesh(
        turned(made.mesh.vertices) / unit, made.mesh.faces.tolist(), material="paint",
        normals=turned(made.mesh.normals), st=made.mesh.uvs, **more,
    )  # fmt: skip
    surface = made.material
    paint = preview(diffuseColor="rgb", roughness=surface.roughness, metallic=surface.metallic)
    return stage(body + paint, up=up, unit=unit)


def picture_of(spec: Path | str) -> np.ndarray:
    """The levels of a picture, of which noise is no part: both are rendered with the same seeds."""
    renderer = advsearch.load_scene(spec).renderer(["pose"], resolution=48, denoise="none")
    return np.round(renderer(renderer.start, seed=3, spp=16).detach().numpy() * 255.0)


def same_picture(one: Path | str, other: Path | str) -> None:
    ours, theirs = picture_of(one), picture_of(other)
    assert np.abs(ours - theirs).max() <= 1.0
    assert np.ptp(theirs) > 50.0


@pytest.mark.parametrize(("up", "unit"), [("Y", 1.0), ("Z", 0.01)])
def test_a_file_looks_as_its_twin_in_gltf(mug: tuple[ObjectAsset, Path], up: str, unit: float) -> None:
    made, folder = mug
    (folder / "mug.usda").write_text(of_mug(made, up=up, unit=unit))
    same_picture(folder / "mug.usda", folder / "twin.glb")
    ours, theirs = import_object(folder / "mug.usda"), import_object(folder / "twin.glb")
    assert ours.size_in_metres == pytest.approx(theirs.size_in_metres) and not ours.warnings
    assert faults_of(folder / "mug.usda") == []


def faults_of(path: Path) -> list[str]:
    """What the validators say of a file that `usdchecker` runs."""
    from pxr import Usd, UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    return [f"{one.GetName()}: {one.GetMessage()}" for one in found]


def test_binary_files_and_packages_are_the_same(mug: tuple[ObjectAsset, Path]) -> None:
    from pxr import Sdf

    made, folder = mug
    (folder / "mug.usda").write_text(of_mug(made))
    expected = import_object(folder / "mug.usda")
    layer = Sdf.Layer.FindOrOpen(str(folder / "mug.usda"))
    assert layer.Export(str(folder / "mug.usdc")) and layer.Export(str(folder / "plain.usd"))
    with zipfile.ZipFile(folder / "mug.usdz", "w") as archive:
        archive.write(folder / "mug.usdc", "mug.usdc")
        archive.write(folder / "skin.png", "skin.png")
    for name in ("mug.usdc", "plain.usd", "mug.usdz"):
        found = import_object(folder / name)
        assert np.array_equal(found.mesh.vertices, expected.mesh.vertices)
        assert np.array_equal(found.base_color, expected.base_color)


def written(folder: Path, body: str, **head: Any) -> Path:
    file = folder / "scene.usda"
    file.write_text(stage(body, **head))
    return file


def skin(folder: Path) -> None:
    levels = np.zeros((8, 8, 3), np.uint8)
    levels[:4], levels[4:] = (200, 40, 40), (40, 40, 200)
    Image.fromarray(levels).save(folder / "skin.png")


def test_subsets_have_materials_of_their_own(tmp_path: Path) -> None:
    subset = """
        def GeomSubset "top" (prepend apiSchemas = ["MaterialBindingAPI"]) {
            uniform token elementType = "face"
            uniform token familyName = "materialBind"
            int[] indices = [0, 1]
            rel material:binding = </Root/red>
        }"""
    body = mesh(CUBE, SIDES, material="blue", more=subset)
    body += preview("red", diffuseColor=(1, 0, 0), roughness=0.3) + preview(
        "blue", diffuseColor=(0, 0, 1), roughness=0.3
    )
    found = import_object(written(tmp_path, body))
    assert set(found.mesh.materials) == {"red", "blue"}
    assert [len(found.mesh.materials[name]) for name in ("red", "blue")] == [4, 8]
    assert found.material.roughness == pytest.approx(0.3) and found.material.metallic == 0.0


def test_numbers_and_pictures_of_a_preview_surface(tmp_path: Path) -> None:
    """Two pictures of numbers become their means, of linear values as USD says of colours of 8 bits; the emission is
    linear, the colour times its scale."""
    skin(tmp_path)
    st = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.4], [0.1, 0.4]])  # the lower half, which is blue
    square = mesh(CUBE[[0, 4, 6, 2]], [[0, 1, 2, 3]], material="paint", st=st)
    paint = preview(diffuseColor="rgb", roughness="g", metallic="r", emissiveColor=(2.0, 1.0, 0.5))
    paint = paint.replace("float3 outputs:rgb", "float4 inputs:scale = (1, 1, 0.5, 1)\n            float3 outputs:rgb")
    found = import_object(written(tmp_path, square + paint))
    decoded = ((40 / 255 + 0.055) / 1.055) ** 2.4
    assert found.material.roughness == pytest.approx(decoded, abs=0.004)
    assert found.material.metallic == pytest.approx(decoded, abs=0.004)
    assert "roughness that is decoded from sRGB" in " ".join(found.warnings)
    assert found.emission is not None and np.allclose(found.emission.max(axis=(0, 1)), [2.0, 1.0, 0.5], rtol=0.01)
    dark = ((200 / 255 + 0.055) / 1.055) ** 2.4 * 0.5
    blue = found.base_color[-2, 1, 2]
    assert ((blue + 0.055) / 1.055) ** 2.4 == pytest.approx(dark, rel=0.05)


@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
def test_polygons_holes_and_orientation(tmp_path: Path, orientation: str) -> None:
    """A concave polygon is cut up as it is; a face that is a hole is none."""
    points = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [1, 0.5, 0], [0, 2, 0], [5, 0, 0], [6, 0, 0], [6, 1, 0]], float)
    faces = [[0, 1, 2, 3, 4], [5, 6, 7]]
    faces = faces if orientation == "rightHanded" else [face[::-1] for face in faces]
    more = f'uniform token orientation = "{orientation}"\n        int[] holeIndices = [1]'
    found = import_object(written(tmp_path, mesh(points, faces, more=more)))
    corners = found.mesh.vertices[found.mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.linalg.norm(across, axis=1).sum() / 2 == pytest.approx(2.5 / 4.0, rel=1e-4), "of a largest extent of 1"
    assert (across[:, 1] < 0).all(), "towards the viewer, which is +z with y up"


ROOM = f"""
    def Xform "shelf" {{
        double3 xformOp:translate = (10, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        {mesh(CUBE, SIDES, name="book")}
        {mesh(CUBE + 3.0, SIDES, name="jar")}
    }}
    def Camera "front" {{
        float focalLength = 50
        float horizontalAperture = 36
        float verticalAperture = 24
        double3 xformOp:translate = (10, 1, 20)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
    def SphereLight "bulb" {{
        float inputs:radius = 2
        float inputs:intensity = 3
        float inputs:exposure = 1
        color3f inputs:color = (1, 0.5, 0.25)
        double3 xformOp:translate = (10, 9, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
    def SphereLight "beam" (prepend apiSchemas = ["ShapingAPI"]) {{
        float inputs:radius = 2
        float inputs:intensity = 8
        bool inputs:normalize = 1
        float inputs:shaping:cone:angle = 30
        float inputs:shaping:cone:softness = 0.5
        double3 xformOp:translate = (10, 9, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
    def DistantLight "sun" {{
        float inputs:angle = 0.53
        float inputs:intensity = 50000
    }}
    def DomeLight "sky" {{}}
"""


def test_nodes_cameras_and_lights_are_those_of_the_file(tmp_path: Path) -> None:
    """Radiance times the disk of a sphere is its intensity; normalised, the power is that of the number."""
    scene = load_description(f"{written(tmp_path, ROOM, unit=0.5)}#book")
    assert set(scene.meshes) == {"object", "jar"}
    jar = scene.meshes["jar"].to_world
    assert np.allclose(jar[:3, 3], [3.0, -3.0, 3.0]), "z up, in sizes of the book"
    camera = scene.cameras["front"]
    assert camera.fov == pytest.approx(2 * math.degrees(math.atan(0.36)))
    assert np.allclose(camera.to_world[:3, 3], [-0.5, -19.5, 1.0]) and not camera.upright
    lamps = {part.name: part for part in scene.parts if isinstance(part, (PointLamp, SpotLamp))}
    bulb, beam, sun = (lamps[name] for name in ("bulb", "beam", "sun"))
    assert np.allclose(bulb.position, [-0.5, 0.5, 9.0])
    assert np.allclose(bulb.intensity, 6 * math.pi * 4 * np.array([1.0, 0.5, 0.25])), "in sizes of the book, 0.5 m"
    assert isinstance(beam, SpotLamp) and np.allclose(beam.direction, [0.0, 1.0, 0.0], atol=1e-6)
    assert [beam.cutoff, beam.beam] == pytest.approx([30.0, 15.0])
    assert beam.intensity[0] == pytest.approx(2.0 * 0.25 / 0.25)
    assert sun.intensity[0] / 1000.0**2 == pytest.approx(50000 * math.pi * math.sin(math.radians(0.265)) ** 2, rel=1e-3)
    assert "DomeLight, which is left out" in said(scene)


def said(scene: SceneDescription) -> str:
    return " ".join(scene.object.warnings)


def test_references_payloads_variants_and_instances(tmp_path: Path) -> None:
    """A variant that is chosen in the file, and a part of another file, twice as an instance."""
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "leg.usda").write_text(stage(mesh(CUBE * [0.1, 1, 0.1], SIDES, name="stick")))
    legs = "".join(
        f"""
    def Xform "leg{x}" (
        instanceable = true
        {how} = @parts/leg.usda@
    ) {{
        double3 xformOp:translate = ({x}, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}"""
        for x, how in ((0, "prepend references"), (1, "prepend payload"))
    )
    head = """
    def Xform "top" (
        variants = { string form = "wide" }
        prepend variantSets = "form"
    ) {
        variantSet "form" = {
            "narrow" { %s }
            "wide" { %s }
        }
    }"""
    narrow, wide = (mesh(CUBE * [size, 0.1, 1], SIDES, name="board") for size in (1.0, 3.0))
    file = written(tmp_path, legs + head % (narrow, wide))
    found = read_file_contents(file)
    assert [one.triangles for one in found.nodes] == [12, 12, 12]
    names = [one.name for one in found.nodes]
    assert names == ["Root/leg0/stick", "Root/leg1/stick", "board"]
    sizes = {one.name: one.size for one in found.nodes}
    assert sizes["board"] == pytest.approx((3.0, 0.1, 1.0)) and sizes["Root/leg1/stick"] == pytest.approx((0.1, 1, 0.1))


def test_a_skeleton_is_at_rest(tmp_path: Path) -> None:
    """Bound in one pose, at rest in another: the upper joint is moved by 2 in x, and its points with it."""
    identity = "( (1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,0,1) )"
    moved = "( (1,0,0,0), (0,1,0,0), (0,0,1,0), (2,0,0,1) )"
    weights = [int(point[1]) for point in CUBE]
    more = f"""
        int[] primvars:skel:jointIndices = {weights} (
            interpolation = "vertex"
            elementSize = 1
        )
        float[] primvars:skel:jointWeights = {[1.0] * 8} (
            interpolation = "vertex"
            elementSize = 1
        )
        rel skel:skeleton = </Root/bones>
    """
    body = mesh(CUBE, SIDES, name="arm", more=more).replace('"MaterialBindingAPI"', '"SkelBindingAPI"')
    body += f"""
    def Skeleton "bones" {{
        uniform token[] joints = ["low", "low/high"]
        uniform matrix4d[] bindTransforms = [{identity}, {identity}]
        uniform matrix4d[] restTransforms = [{identity}, {moved}]
    }}"""
    (node,) = read_file_contents(written(tmp_path, body, root="SkelRoot")).nodes
    assert node.size == pytest.approx((3.0, 1.0, 1.0))


def refers_to(name: str) -> str:
    return f'    def Xform "part" (prepend references = @{name}@) {{}}\n' + mesh(CUBE, SIDES)


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        (refers_to("/etc/hosts.usda"), "/etc/hosts.usda"),
        (refers_to("../outside.usda"), "../outside.usda"),
        (refers_to("link.usda"), "link.usda"),
        (refers_to("https://example.org/a.usda"), "https:"),
        (refers_to("a.usdz[b.usda]"), r"a.usdz\[b.usda\]"),
        (refers_to("a.usda[b.usda]"), r"a.usda\[b.usda\]"),
        (refers_to("gone.usda"), "gone.usda"),
        (refers_to("picture.png"), "picture.png"),
        (refers_to("broken.usda"), "broken.usda"),
        ('    def Xform "a" (clips = { dictionary default = { asset[] assetPaths = [@x.usda@] } }) {}', "value clips"),
        (mesh(CUBE, [[0, 1, 99]]), "/Root/thing"),
        (mesh(CUBE, [[0, 1, 3]], normals=[[0, 0, 1]] * 2), "/Root/thing"),
        ('    def Xform "nothing" {}', "scene.usda"),
    ],
)  # fmt: skip
def test_what_is_refused(tmp_path: Path, body: str, expected: str) -> None:
    folder = tmp_path / "inside"
    folder.mkdir()
    (tmp_path / "outside.usda").write_text(stage(mesh(CUBE, SIDES)))
    (folder / "link.usda").symlink_to(tmp_path / "outside.usda")
    (folder / "broken.usda").write_text("#usda 1.0\ndef Mesh {")
    file = written(folder, body)
    with pytest.raises(FileFormatError, match=expected) as raised:
        import_object(file)
    assert str(raised.value).startswith(str(folder))


@pytest.mark.parametrize(
    ("name", "compression"),
    [
        ("../out.usda", zipfile.ZIP_STORED), ("/tmp/out.usda", zipfile.ZIP_STORED), ("C:out.usda", zipfile.ZIP_STORED),
        ("a.usda", zipfile.ZIP_DEFLATED), ("a.png", zipfile.ZIP_STORED),
    ],
)  # fmt: skip
def test_packages_that_are_refused(tmp_path: Path, name: str, compression: int) -> None:
    file = tmp_path / "a.usdz"
    with zipfile.ZipFile(file, "w", compression) as archive:
        archive.writestr(name, stage(mesh(CUBE, SIDES)))
    with pytest.raises(FileFormatError, match=r"a\.usdz"):
        import_object(file)
    assert not (tmp_path.parent / "out.usda").exists()


def test_damaged_files_and_large_ones_end_in_a_sentence(
    tmp_path: Path, mug: tuple[ObjectAsset, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    from pxr import Sdf

    made, folder = mug
    (folder / "mug.usda").write_text(of_mug(made))
    Sdf.Layer.FindOrOpen(str(folder / "mug.usda")).Export(str(folder / "mug.usdc"))
    data = (folder / "mug.usdc").read_bytes()
    generator = np.random.default_rng(1)
    for number in range(4):
        broken = bytearray(data[: len(data) // (1 + number % 2)])
        for place in generator.integers(8, len(broken), 40):
            broken[place] = generator.integers(256)
        file = tmp_path / f"broken{number}.usdc"
        file.write_bytes(broken)
        try:
            import_object(file)
        except InputError as error:  # also of what can be read and is no object, such as faces without an area
            assert str(file.name) in str(error) and str(error).isprintable()
    monkeypatch.setenv("ADVSEARCH_LIMITS", "0.0003")
    with pytest.raises(FileFormatError, match=r"at most|usd-core could not read it"):
        import_object(folder / "mug.usda")


def test_opacity_cuts_out_and_a_transform_moves_the_texture(tmp_path: Path) -> None:
    skin(tmp_path)
    levels = np.full((8, 8, 4), 255, np.uint8)
    levels[:, :4, 3] = 0
    Image.fromarray(levels).save(tmp_path / "leaf.png")
    st = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    square = mesh(CUBE[[0, 4, 6, 2]], [[0, 1, 2, 3]], material="paint", st=st)
    leaf = preview(picture="leaf.png", diffuseColor="rgb", opacity="a", opacityThreshold=0.5)
    found = import_object(written(tmp_path, square + leaf))
    assert found.opacity is not None and found.opacity.mean() == pytest.approx(0.5, abs=0.1)
    moved = preview(diffuseColor="rgb").replace(
        'def Shader "color" {',
        """def Shader "moved" {
            uniform token info:id = "UsdTransform2d"
            float2 inputs:in.connect = </Root/paint/st.outputs:result>
            float2 inputs:scale = (1, 0.25)
            float2 inputs:translation = (0, 0.6)
            float2 outputs:result
        }
        def Shader "color" {""",
    )
    moved = moved.replace("inputs:st.connect = </Root/paint/st.", "inputs:st.connect = </Root/paint/moved.")
    found = import_object(written(tmp_path, square + moved))
    assert found.mesh.uvs[:, 1].min() == pytest.approx(0.6) and found.mesh.uvs[:, 1].max() == pytest.approx(0.85)
