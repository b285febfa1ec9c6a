"""Preview surfaces of OpenUSD, their textures and display colours: each beside what the specification says."""

import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from advsearch.errors import FileFormatError
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing.objects import read_parts
from advsearch.scene.importing.parts import ImportedPart

pytestmark = pytest.mark.island("advsearch.scene.importing.usd")

usd_stage = pytest.importorskip("advsearch.scene.importing.usd.stage", exc_type=ImportError)

SQUARE = "[(0,0,0), (1,0,0), (1,1,0), (0,1,0)]"
STRETCHED = "[(-1,-1), (2,-1), (2,2), (-1,2)]"
UNIT = "[(0,0), (1,0), (1,1), (0,1)]"


def reader(name: str, varname: str, kind: str = "float2", more: str = "") -> str:
    return f"""
        def Shader "{name}" {{
            uniform token info:id = "UsdPrimvarReader_{kind}"
            string inputs:varname = "{varname}"
            {more}
            {kind} outputs:result
        }}"""


def texture(name: str, file: str, more: str = "", st: str = "by_st") -> str:
    looked_up = f"float2 inputs:st.connect = </Root/m/{st}.outputs:result>" if st else ""
    return f"""
        def Shader "{name}" {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @{file}@
            {looked_up}
            {more}
            float3 outputs:rgb
            float outputs:r
            float outputs:g
            float outputs:b
            float outputs:a
        }}"""


def write_stage(folder: Path, inputs: str = "", shaders: str = "", mesh: str = "", st: str = UNIT) -> Path:
    """Write a square with a preview surface, if it has inputs, and return the file."""
    material = f"""
    def Material "m" {{
        token outputs:surface.connect = </Root/m/s.outputs:surface>
        def Shader "s" {{
            uniform token info:id = "UsdPreviewSurface"
            {inputs}
            token outputs:surface
        }}
        {reader("by_st", "st")}
        {shaders}
    }}"""
    bound = "rel material:binding = </Root/m>" if inputs else ""
    file = folder / "scene.usda"
    file.write_text(f"""#usda 1.0
(
    defaultPrim = "Root"
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "Root" {{
    def Mesh "square" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
        uniform token subdivisionScheme = "none"
        int[] faceVertexCounts = [3, 3]
        int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
        point3f[] points = {SQUARE}
        texCoord2f[] primvars:st = {st} (interpolation = "vertex")
        {bound}
        {mesh}
    }}
    {material if inputs else ""}
}}
""")
    return file


def parts_of(file: Path) -> tuple[list[ImportedPart], str]:
    """Return the parts of a file and what is said of it, without a process of its own."""
    made = file.with_suffix(".glb")
    package = file.parent / "package"
    package.mkdir(exist_ok=True)
    usd_stage.main(str(file), str(made), str(package))
    parts, notes = read_parts(made, made.read_bytes())
    return parts, " ".join(notes)


def part_of(folder: Path, *args: Any, **kwargs: Any) -> tuple[ImportedPart, str]:
    parts, notes = parts_of(write_stage(folder, *args, **kwargs))
    assert len(parts) == 1
    return parts[0], notes


COLOR_OF_188 = srgb_to_linear(np.array([188, 100, 50], np.float32) / np.float32(255))


def linear_color(part: ImportedPart) -> np.ndarray:
    """Return the mean linear colour of a part."""
    surface = part.surface
    if surface.texture is not None:
        return np.asarray(srgb_to_linear(surface.texture[:, :, :3]).mean(axis=(0, 1)))
    assert surface.color is not None
    return np.asarray(srgb_to_linear(surface.color[:3]))


def save(file: Path, levels: object) -> None:
    Image.fromarray(np.asarray(levels, np.uint8)).save(file)


def halves(file: Path) -> None:
    """Red below, blue on top."""
    levels = np.zeros((8, 8, 3), np.uint8)
    levels[:4], levels[4:] = (0, 0, 255), (255, 0, 0)
    save(file, levels)


REPEAT = 'token inputs:wrapS = "repeat"\ntoken inputs:wrapT = "repeat"'
COLOR = "color3f inputs:diffuseColor.connect = </Root/m/t.outputs:rgb>"


def test_each_texture_is_looked_up_by_its_own_reader(tmp_path: Path) -> None:
    """The colour by st, the roughness by st1, which lies on the dark half of its picture."""
    halves(tmp_path / "halves.png")
    levels = np.full((8, 8), 51, np.uint8)
    levels[4:] = 204
    save(tmp_path / "rough.png", levels)
    inputs = COLOR + "\nfloat inputs:roughness.connect = </Root/m/u.outputs:r>"
    shaders = reader("by_st1", "st1") + texture("t", "halves.png", REPEAT) + texture("u", "rough.png", st="by_st1")
    st1 = "texCoord2f[] primvars:st1 = [(0,.6), (1,.6), (1,.9), (0,.9)] (interpolation = 'vertex')"
    part, notes = part_of(tmp_path, inputs, shaders, st1)
    assert part.uvs is not None and part.surface.texture is not None
    lowest = part.uvs[part.vertices[:, 1] == 0.0]
    assert np.allclose(lowest[:, 1], 0.0), "not turned, as st1 would do"
    assert part.surface.roughness == pytest.approx(0.2, abs=0.005)
    assert "is left out" not in notes


@pytest.mark.parametrize(
    ("levels", "space", "expected"),
    [
        ([[[188, 100, 50]]], "raw", np.array([188, 100, 50]) / 255), ([[[188, 100, 50]]], "sRGB", COLOR_OF_188),
        ([[[188, 100, 50]]], "auto", COLOR_OF_188), ([[[188, 100, 50, 255]]], "auto", COLOR_OF_188),
        ([[188]], "auto", np.full(3, 188 / 255)), ([[188]], "sRGB", srgb_to_linear(np.full(3, 188 / 255, np.float32))),
    ],
)  # fmt: skip
def test_color_spaces(tmp_path: Path, levels: object, space: str, expected: np.ndarray) -> None:
    save(tmp_path / "a.png", levels)
    more = f'token inputs:sourceColorSpace = "{space}"'
    part, _ = part_of(tmp_path, COLOR, texture("t", "a.png", more))
    assert np.allclose(linear_color(part), expected, atol=0.005)


def png_of_16_bits(values: np.ndarray, filters: list[int]) -> bytes:
    """Return a PNG file of (H, W, C) numbers in 16 bits whose rows have those filters."""
    height, width, channels = values.shape
    step, raw = 2 * channels, values.astype(">u2").tobytes()
    rows = np.frombuffer(raw, np.uint8).reshape(height, width * step).astype(int)
    stream, above = bytearray(), np.zeros(width * step, int)
    for row, kind in zip(rows, filters, strict=True):
        left = np.concatenate([np.zeros(step, int), row[:-step]])
        corner = np.concatenate([np.zeros(step, int), above[:-step]])
        far = [np.abs(left + above - corner - near) for near in (left, above, corner)]
        paeth = np.where((far[0] <= far[1]) & (far[0] <= far[2]), left, np.where(far[1] <= far[2], above, corner))
        predicted = [0 * row, left, above, (left + above) // 2, paeth][kind]
        stream += bytes([kind]) + ((row - predicted) % 256).astype(np.uint8).tobytes()
        above = row

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    color_type = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    head = struct.pack(">IIBBBBB", width, height, 16, color_type, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(stream))) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_pictures_of_16_bits_are_linear_to_the_last_bit(channels: int) -> None:
    from advsearch.scene.importing.usd.pictures import decode_image, is_marked_srgb

    values = np.random.default_rng(4).integers(0, 65536, (5, 7, channels))
    data = png_of_16_bits(values, [0, 1, 2, 3, 4])
    assert not is_marked_srgb(data)
    texels = decode_image(data, "a.png", is_srgb=False)
    colors = np.broadcast_to(values[:, :, :3] if channels > 2 else values[:, :, :1], (5, 7, 3)) / 65535
    assert np.allclose(texels[:, :, :3], colors, atol=1e-6) or channels == 2
    if channels in (2, 4):
        assert np.allclose(texels[:, :, 3], values[:, :, -1] / 65535, atol=0.004)


def test_scale_bias_and_single_channels(tmp_path: Path) -> None:
    save(tmp_path / "a.png", [[[188, 128, 64, 255]]])
    more = "float4 inputs:scale = (0.2, 0.2, 0.2, 1)\nfloat4 inputs:bias = (0.4, 0, 0.1, 0)"
    part, _ = part_of(tmp_path, COLOR, texture("t", "a.png", more))
    expected = srgb_to_linear(np.array([188, 128, 64], np.float32) / np.float32(255)) * 0.2 + [0.4, 0.0, 0.1]
    assert np.allclose(linear_color(part), expected, atol=0.005)
    numbers = """
        float inputs:roughness.connect = </Root/m/t.outputs:g>
        float inputs:metallic.connect = </Root/m/t.outputs:b>"""
    more = 'token inputs:sourceColorSpace = "raw"\n'
    more += "float4 inputs:scale = (1, .5, 2, 1)\nfloat4 inputs:bias = (0, .25, -.1, 0)"
    part, _ = part_of(tmp_path, numbers, texture("t", "a.png", more))
    assert part.surface.roughness == pytest.approx(128 / 510 + 0.25, abs=0.004)
    assert part.surface.metallic == pytest.approx(128 / 255 - 0.1, abs=0.004)


@pytest.mark.parametrize("output", ["r", "g", "b", "a"])
def test_an_opacity_of_any_channel_of_another_picture(tmp_path: Path, output: str) -> None:
    levels = np.zeros((8, 8, 4), np.uint8)
    levels[:4, :, "rgba".index(output)] = 255
    save(tmp_path / "cut.png", levels)
    save(tmp_path / "a.png", np.full((2, 2, 3), 200))
    inputs = (
        COLOR
        + f"""
        float inputs:opacity.connect = </Root/m/u.outputs:{output}>
        float inputs:opacityThreshold = 0.5"""
    )
    raw = 'token inputs:sourceColorSpace = "raw"'
    part, notes = part_of(tmp_path, inputs, texture("t", "a.png") + texture("u", "cut.png", raw))
    assert part.surface.texture is not None and part.surface.texture.shape[2] == 4
    opacity = part.surface.texture[:, :, 3]
    assert opacity[0].min() == 1.0 and opacity[-1].max() == 0.0 and "left out" not in notes


@pytest.mark.parametrize(
    ("wrap", "expected"),
    [
        ("repeat", (0.5, 0.0, 0.5)), ("clamp", (0.5, 0.0, 0.5)), ("black", (0.5 / 9, 0.0, 0.5 / 9)),
        ("useMetadata", (0.5 / 9, 0.0, 0.5 / 9)),
    ],
)  # fmt: skip
def test_how_pictures_go_on(tmp_path: Path, wrap: str, expected: tuple[float, ...]) -> None:
    """Texture coordinates reach one picture beyond each edge: with black, a ninth is the picture."""
    halves(tmp_path / "halves.png")
    more = f'token inputs:wrapS = "{wrap}"\ntoken inputs:wrapT = "{wrap}"'
    part, notes = part_of(tmp_path, COLOR, texture("t", "halves.png", more), st=STRETCHED)
    assert part.surface.texture is not None and part.uvs is not None
    if wrap != "repeat":
        assert part.uvs.min() > 0.0 and part.uvs.max() < 1.0
        assert np.allclose(linear_color(part), expected, atol=0.01)
    assert "left out" not in notes


def test_transforms_in_a_row_and_of_one_texture_only(tmp_path: Path) -> None:
    """Turned by 90 degrees, then moved by a quarter."""
    halves(tmp_path / "halves.png")
    transform = """
        def Shader "{name}" {{
            uniform token info:id = "UsdTransform2d"
            float2 inputs:in.connect = </Root/m/{source}.outputs:result>
            {more}
            float2 outputs:result
        }}"""
    shaders = transform.format(name="turn", source="by_st", more="float inputs:rotation = 90")
    shaders += transform.format(name="move", source="turn", more="float2 inputs:translation = (1, 0.25)")
    part, notes = part_of(tmp_path, COLOR, shaders + texture("t", "halves.png", REPEAT, st="move"))
    assert part.uvs is not None
    corner = part.uvs[np.argmax(part.vertices[:, 0] - part.vertices[:, 1])]  # st = (1, 0)
    assert np.allclose(corner, [1.0, 1.25]), "(1, 0) turned is (0, 1)"
    assert "left out" not in notes


def test_normal_maps_by_their_scale_and_bias(tmp_path: Path) -> None:
    """Also with y down, without both, and in floats as they are."""
    save(tmp_path / "n.png", np.full((4, 4, 3), (128, 178, 246)))
    inputs = "normal3f inputs:normal.connect = </Root/m/t.outputs:rgb>"
    raw = 'token inputs:sourceColorSpace = "raw"\n'
    y = {}
    for name, more in {
        "usual": "float4 inputs:scale = (2, 2, 2, 1)\nfloat4 inputs:bias = (-1, -1, -1, 0)",
        "down": "float4 inputs:scale = (2, -2, 2, 1)\nfloat4 inputs:bias = (-1, 1, -1, 0)",
        "without": "",
    }.items():
        part, notes = part_of(tmp_path, inputs, texture("t", "n.png", raw + more))
        assert part.surface.normal_map is not None
        y[name] = float(part.surface.normal_map[0, 0, 1] * 2 - 1)
        assert ("without scale" in notes) == (name == "without")
    assert y["usual"] == pytest.approx(0.39, abs=0.02)
    assert y["down"] == pytest.approx(-0.39, abs=0.02) and y["without"] == pytest.approx(y["usual"], abs=0.01)


def colors_of(parts: list[ImportedPart]) -> list[tuple[float, ...]]:
    return sorted(tuple(np.round(linear_color(part), 2)) for part in parts)


def test_display_colors_and_opacities_of_faces_and_vertices(tmp_path: Path) -> None:
    uniform = 'color3f[] primvars:displayColor = [(1, 0, 0), (0, 0, 1)] (interpolation = "uniform")'
    parts, _ = parts_of(write_stage(tmp_path, mesh=uniform))
    assert colors_of(parts) == [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)]
    indexed = uniform + "\nint[] primvars:displayColor:indices = [1, 1]"
    parts, _ = parts_of(write_stage(tmp_path, mesh=indexed))
    assert colors_of(parts) == [(0.0, 0.0, 1.0)]
    vertex = 'color3f[] primvars:displayColor = [(1, 0, 0), (1, 0, 0), (0, 0, 1), (0, 1, 0)] (interpolation = "vertex")'
    (part,), _ = parts_of(write_stage(tmp_path, mesh=vertex))
    assert part.colors is not None and np.allclose(linear_color(part), 1.0)
    blue = (part.vertices[part.faces] == [1.0, 1.0, 0.0]).all(axis=2)
    assert np.allclose(part.colors[blue], [0.0, 0.0, 1.0])
    opacity = 'float[] primvars:displayOpacity = [0.25, 1] (interpolation = "uniform")'
    parts, _ = parts_of(write_stage(tmp_path, mesh=opacity))
    colors = [part.surface.color for part in parts if part.surface.color is not None]
    shares = sorted(1.0 if len(color) == 3 else float(color[3]) for color in colors)
    assert shares == pytest.approx([0.25, 1.0], abs=0.003)


def write_package(folder: Path, name: str, entries: dict[str, bytes]) -> None:
    with zipfile.ZipFile(folder / name, "w") as archive:
        for entry, content in entries.items():
            archive.writestr(entry, content)


def referring(name: str) -> str:
    return f"""#usda 1.0
(
    defaultPrim = "Scene"
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "Scene" {{
    def "part" (prepend references = @{name}@) {{}}
}}
"""


def test_packages_are_layers_also_in_others(tmp_path: Path) -> None:
    save(tmp_path / "a.png", [[[188, 100, 50]]])
    inside = write_stage(tmp_path, COLOR, texture("t", "pictures/a.png")).read_bytes()
    entries = {"a.usda": inside, "pictures/a.png": (tmp_path / "a.png").read_bytes()}
    (tmp_path / "scenes").mkdir()
    folder = tmp_path / "scenes"
    write_package(folder, "inner.usdz", entries)
    packed = (folder / "inner.usdz").read_bytes()
    write_package(folder, "outer.usdz", {"b.usda": referring("inner.usdz").encode(), "inner.usdz": packed})
    for name in ("inner.usdz", "./outer.usdz", "inner.usdz[a.usda]"):
        file = folder / "scene.usda"
        file.write_text(referring(name))
        (part,), notes = parts_of(file)
        assert np.allclose(linear_color(part), COLOR_OF_188, atol=0.004), name
        assert "missing" not in notes
    (part,), _ = parts_of(folder / "outer.usdz")
    assert np.allclose(linear_color(part)[0], srgb_to_linear(np.array(188 / 255, np.float32)), atol=0.004)


@pytest.mark.parametrize(
    "entries",
    [
        {"a.usda": referring("../../outside.usda").encode()}, {"a.usda": referring("/tmp/x.usda").encode()},
        {"a.usda": referring("gone.usda").encode()}, {"a.usda": b"#usda 1.0\ndef Mesh {"}, {"a.png": b"x"},
    ],
)  # fmt: skip
def test_what_packages_may_not_name(tmp_path: Path, entries: dict[str, bytes]) -> None:
    folder = tmp_path / "inside"
    folder.mkdir()
    (tmp_path / "outside.usda").write_text(referring("x.usda"))
    write_package(folder, "a.usdz", entries)
    (folder / "scene.usda").write_text(referring("a.usdz"))
    with pytest.raises(FileFormatError, match=r"a\.usdz"):
        parts_of(folder / "scene.usda")
