"""glTF as its specification has it: what is in a file is either read so, or named as left out."""

import io
import json
import struct
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as some
from PIL import Image, PngImagePlugin

import advsearch
from advsearch.errors import FileFormatError
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing.gltf_parts import EDGES_NOTE
from advsearch.scene.importing.objects import import_object, read_parts
from advsearch.scene.importing.parts import ImportedPart
from advsearch.scene.importing.texture import sample_colors, sample_texture

REPEAT, MIRRORED, CLAMPED, NEAREST, LINEAR = 10497, 33648, 33071, 9728, 9729
TYPES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
WIDTHS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
MAP = np.array([[0, 1], [1, 1], [1, 0], [0, 0.0]])  # v = 0 is the top of the picture
FACES = np.array([0, 1, 2, 0, 2, 3])


class File:
    """A .glb file in the making, of one mesh; further entries of the header are up to the test."""

    def __init__(self, **material: Any) -> None:
        self.data = b""
        self.header: dict[str, Any] = {
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": []}], "accessors": [], "bufferViews": [], "buffers": [],
            "materials": [material],
        }  # fmt: skip

    def view(self, content: bytes, **entries: Any) -> int:
        self.data += bytes(-len(self.data) % 4)
        entry = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content), **entries}
        self.header["bufferViews"].append(entry)
        self.data += content
        return len(self.header["bufferViews"]) - 1

    def values(self, values: np.ndarray, kind: str = "f4", *, normalized: bool = False, **entries: Any) -> int:
        """Add an accessor; normalised ones get values of [0, 1] or [-1, 1]."""
        values = np.asarray(values, np.float64).reshape(len(values), -1)
        if normalized:
            values = np.round(values * np.iinfo(kind).max)
        padding = bytes(-(values.shape[1] * np.dtype(kind).itemsize) % 4)
        content = b"".join(row.tobytes() + padding for row in values.astype(f"<{kind}"))
        if values.shape[1] == 1:
            content, padding = values.astype(f"<{kind}").tobytes(), b""
        stride = {"byteStride": values.shape[1] * np.dtype(kind).itemsize + len(padding)} if padding else {}
        self.header["accessors"].append({
            "bufferView": self.view(content, **stride), "componentType": TYPES[kind], "count": len(values),
            "type": WIDTHS[values.shape[1]], **({"normalized": True} if normalized else {}), **entries,
        })  # fmt: skip
        return len(self.header["accessors"]) - 1

    def texture(self, pixels: np.ndarray, **sampler: int) -> dict[str, int]:
        """Add a picture, a sampler if it has entries, and a texture; return its use."""
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, "PNG")
        return self.picture(file.getvalue(), **sampler)

    def picture(self, content: bytes, **sampler: int) -> dict[str, int]:
        """As `texture`, with the bytes of a picture file."""
        images, textures, samplers = (self.header.setdefault(key, []) for key in ("images", "textures", "samplers"))
        images.append({"bufferView": self.view(content)})
        textures.append({"source": len(images) - 1})
        if sampler:
            samplers.append(sampler)
            textures[-1]["sampler"] = len(samplers) - 1
        return {"index": len(textures) - 1}

    def primitive(self, positions: np.ndarray = SQUARE, indices: np.ndarray | None = FACES, **entries: Any) -> Any:
        """Add a primitive; attributes are `entries["attributes"]`, and POSITION where they have none."""
        attributes = {**entries.pop("attributes", {})}
        attributes.setdefault("POSITION", None)
        if attributes["POSITION"] is None:
            attributes["POSITION"] = self.values(positions)
        given = {} if indices is None else {"indices": self.values(indices, "u2")}
        made = {"attributes": attributes, "material": 0, **given, **entries}
        self.header["meshes"][0]["primitives"].append({key: one for key, one in made.items() if one is not None})
        return made

    def write(self, folder: Path) -> Path:
        self.header["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps({key: value for key, value in self.header.items() if value != []}).encode()
        text, data = text + b" " * (-len(text) % 4), self.data + bytes(-len(self.data) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
        path = folder / "made.glb"
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


def parts_of(file: File, folder: Path) -> tuple[list[ImportedPart], list[str]]:
    path = file.write(folder)
    parts, notes = read_parts(path, path.read_bytes())
    return parts, [note.removeprefix("made.glb").removeprefix(":").strip() for note in notes]


def area(part: ImportedPart) -> np.ndarray:
    """The vectors of all faces, added up; for a flat piece (3,) along its front, as long as its area."""
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    return np.asarray(np.cross(b - a, c - a).sum(axis=0) / 2.0)


@pytest.mark.parametrize(
    ("positions", "kind", "normalized"),
    [
        (SQUARE, "f4", False), (SQUARE, "u1", True), (SQUARE, "i2", True),
        (SQUARE * 100.0, "u1", False), (SQUARE * -2000.0, "i2", False),
    ],
)  # fmt: skip
def test_quantized_geometry_is_read(positions: np.ndarray, kind: str, normalized: bool, tmp_path: Path) -> None:
    file = File(pbrMetallicRoughness={"metallicFactor": 0.0})
    file.header |= {"extensionsUsed": ["KHR_mesh_quantization"], "extensionsRequired": ["KHR_mesh_quantization"]}
    normal = file.values(np.tile([0.6, 0.0, 0.8], (4, 1)), "i1", normalized=True)
    held = {"POSITION": file.values(positions, kind, normalized=normalized), "NORMAL": normal}
    file.primitive(attributes=held)
    (part,), notes = parts_of(file, tmp_path)
    assert notes == [] and part.normals is not None
    assert part.vertices == pytest.approx(positions, abs=1e-9)
    assert part.normals == pytest.approx(np.tile([0.6, 0.0, 0.8], (4, 1)), abs=0.005)


@pytest.mark.parametrize("based", [False, True])
def test_sparse_accessors_are_read(based: bool, tmp_path: Path) -> None:
    file = File()
    place = file.values(np.zeros((4, 3)) if based else SQUARE)
    rows = [1, 2, 3]
    file.header["accessors"][place] |= {
        "sparse": {
            "count": 3, "indices": {"bufferView": file.view(np.array(rows, "<u2").tobytes()), "componentType": 5123},
            "values": {"bufferView": file.view(SQUARE[rows].astype("<f4").tobytes())},
        }
    }  # fmt: skip
    if not based:
        del file.header["accessors"][place]["bufferView"]  # then all others are 0
    file.primitive(attributes={"POSITION": place})
    (part,), notes = parts_of(file, tmp_path)
    assert notes == [] and np.array_equal(part.vertices, SQUARE)
    elsewhere = file.view(np.array([1, 2, 9], "<u2").tobytes())
    file.header["accessors"][place]["sparse"]["indices"]["bufferView"] = elsewhere
    with pytest.raises(FileFormatError, match="sparse"):
        parts_of(file, tmp_path)


def test_sharp_texels_stay_sharp(tmp_path: Path) -> None:
    """In the picture, too: a base colour a in white light from everywhere comes out as sRGB(0.625 a)."""
    pixels = np.random.default_rng(3).integers(0, 2, (4, 4, 1), np.uint8).repeat(3, axis=2) * np.uint8(200)
    file = File()
    use = file.texture(pixels, magFilter=NEAREST, minFilter=NEAREST)
    file.header["materials"][0]["pbrMetallicRoughness"] = {"baseColorTexture": use, "metallicFactor": 0}
    file.primitive(SQUARE[:, [0, 2, 1]] * [1, 1, -1], attributes={"TEXCOORD_0": file.values(MAP)})
    path = file.write(tmp_path)
    assert len(np.unique(import_object(path).base_color)) == 2
    white = EnvironmentAsset("white", np.ones((16, 32, 3), np.float32))
    seen = {"ground.size": 0.0, "camera.elevation": 89.0, "camera.azimuth": 0.0, "material.specular": 0.0}
    scene = advsearch.load_scene(path, environment=white, settings=seen)
    renderer = scene.renderer("pose", resolution=64, denoise="none")
    got, inside = renderer(renderer.start, seed=0, spp=64).numpy(), renderer.compute_object_mask(renderer.start).numpy()
    rows, columns = np.flatnonzero(inside.any(1)), np.flatnonzero(inside.any(0))
    wanted = linear_to_srgb((0.625 * srgb_to_linear(pixels / np.float32(255.0))).astype(np.float32))
    side = len(rows) / 4.0
    for row in range(4):
        for column in range(4):
            top, left = (int(start + k * side) + 2 for start, k in ((rows[0], row), (columns[0], column)))
            patch = got[top : top + int(side) - 3, left : left + int(side) - 3]
            assert patch.mean(axis=(0, 1)) == pytest.approx(wanted[row, column], abs=0.02)


def test_a_transform_of_textures_is_applied_as_in_the_example_of_the_extension(tmp_path: Path) -> None:
    """The lower left quarter, turned clockwise by 90 degrees."""
    corners = np.zeros((8, 8, 3), np.uint8)
    for place, color in (((7, 0), 255), ((4, 0), 200), ((4, 3), 150), ((7, 3), 100)):
        corners[place] = color
    file = File()
    given = {"offset": [0, 1], "rotation": np.pi / 2.0, "scale": [0.5, 0.5], "texCoord": 1}
    use = {**file.texture(corners), "extensions": {"KHR_texture_transform": given}}
    file.header["materials"][0]["pbrMetallicRoughness"] = {"baseColorTexture": use}
    file.header["extensionsUsed"] = file.header["extensionsRequired"] = ["KHR_texture_transform"]
    held = {"TEXCOORD_0": file.values(MAP * 0.1), "TEXCOORD_1": file.values(MAP * 0.75 + 0.125)}
    file.primitive(attributes=held)
    (part,), notes = parts_of(file, tmp_path)
    assert notes == [] and part.uvs is not None and part.surface.texture is not None
    got = sample_texture(part.surface.texture, part.uvs)[:, 0] * 255  # bottom left, bottom right, top right, top left
    assert got == pytest.approx([100, 150, 200, 255]) or got == pytest.approx([100, 150, 200, 255][::-1])
    assert part.uvs == pytest.approx(np.array([[0.4375, 0.0625], [0.4375, 0.4375], [0.0625, 0.4375], [0.0625, 0.0625]]))


def png(image: Image.Image, **options: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, "PNG", **options)
    return file.getvalue()


def jpeg(image: Image.Image, **options: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, "JPEG", quality=100, **options)
    return file.getvalue()


def with_gamma() -> bytes:
    """A PNG that says another gamma, which glTF tells readers to ignore."""
    chunks = PngImagePlugin.PngInfo()
    chunks.add(b"gAMA", struct.pack(">I", 100_000))
    return png(Image.new("RGB", (4, 2), (200, 120, 40)), pnginfo=chunks)


def turned() -> bytes:
    """A JPEG whose camera was held sideways, which glTF tells readers to ignore."""
    exif = Image.Exif()
    exif[0x0112] = 6
    return jpeg(Image.new("RGB", (4, 2), (200, 120, 40)), exif=exif.tobytes())


COLOR = np.array([200, 120, 40]) / 255.0
PICTURES: dict[str, tuple[bytes, np.ndarray]] = {
    "palette": (png(Image.new("RGB", (4, 2), (200, 120, 40)).quantize(4)), COLOR),
    "grey": (png(Image.new("L", (4, 2), 120)), np.full(3, 120 / 255)),
    "grey and alpha": (png(Image.new("LA", (4, 2), (120, 9))), np.full(3, 120 / 255)),
    "grey of 16 bits": (png(Image.fromarray(np.full((2, 4), 30_840, np.uint16))), np.full(3, 120 / 255)),
    "one bit": (png(Image.new("1", (4, 2), 1)), np.ones(3)),
    "gamma": (with_gamma(), COLOR),
    "turned": (turned(), COLOR),
    "CMYK": (jpeg(Image.new("CMYK", (4, 2), (55, 135, 215, 0))), COLOR),
}


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_of_all_kinds_are_colours_as_they_are_stored(name: str, tmp_path: Path) -> None:
    content, wanted = PICTURES[name]
    file = File()
    file.header["materials"][0]["pbrMetallicRoughness"] = {"baseColorTexture": file.picture(content)}
    file.primitive(attributes={"TEXCOORD_0": file.values(MAP)})
    (part,), notes = parts_of(file, tmp_path)
    assert notes == [] and part.surface.texture is not None
    assert part.surface.texture.shape == (2, 4, 3)
    assert part.surface.texture == pytest.approx(np.broadcast_to(wanted, (2, 4, 3)), abs=0.01)


def reference(light: np.ndarray, u: float, v: float, wraps: tuple[int, int], *, sharp: bool) -> np.ndarray:
    """Look (H, W, C) texels up as the format says."""

    def texel(index: int, count: int, wrap: int) -> int:
        if wrap == CLAMPED:
            return min(max(index, 0), count - 1)
        if wrap == MIRRORED:
            index %= 2 * count
            return index if index < count else 2 * count - 1 - index
        return index % count

    (height, width), (across, down) = light.shape[:2], wraps
    if sharp:
        row, column = int(np.floor(v * height)), int(np.floor(u * width))
        return np.asarray(light[texel(row, height, down), texel(column, width, across)])
    x, y = u * width - 0.5, v * height - 0.5
    left, top = int(np.floor(x)), int(np.floor(y))
    found = np.zeros(light.shape[2])
    for row, share in ((top, 1 - (y - top)), (top + 1, y - top)):
        for column, part in ((left, 1 - (x - left)), (left + 1, x - left)):
            found += share * part * light[texel(row, height, down), texel(column, width, across)]
    return found


NAMED = {
    "attribute": ("_CUSTOM", "COLOR_1", "TEXCOORD_3", "TANGENT"),
    "entry of a material": ("shininess", "extras"),
    "entry of a sampler": ("anisotropy",),
    "extension": ("KHR_materials_sheen", "KHR_materials_unlit", "ACME_glitter"),
}
EVENLY = some.floats(0.0, 1.0, width=32)


@pytest.mark.medium
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(data=some.data())
def test_whatever_a_file_has_is_read_right_or_named(data: some.DataObject) -> None:
    def one_of(*values: Any) -> Any:
        return data.draw(some.sampled_from(values))

    random = np.random.default_rng(data.draw(some.integers(0, 1000)))
    file, held, said = File(), {}, set[str]()
    surface: dict[str, Any] = {}
    wraps = one_of(REPEAT, MIRRORED, CLAMPED), one_of(REPEAT, MIRRORED, CLAMPED)
    filter, transform = one_of(None, NEAREST, LINEAR), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    pixels = random.integers(0, 256, (one_of(1, 2, 3, 5), one_of(1, 2, 3, 5), 3), dtype=np.uint8)
    textured = one_of(True, True, False)
    if textured:
        sampler = {"wrapS": wraps[0], "wrapT": wraps[1], **({} if filter is None else {"magFilter": filter})}
        use: dict[str, Any] = file.texture(pixels, **sampler)
        if one_of(True, False):
            moved, scale, turn = random.uniform(-1, 1, 2), random.uniform(-2, 2, 2), float(random.uniform(-4, 4))
            given = {"offset": moved.tolist(), "scale": scale.tolist(), "rotation": turn}
            use["extensions"] = {"KHR_texture_transform": given}
            sine, cosine = np.sin(turn), np.cos(turn)
            transform = np.array([[cosine * scale[0], sine * scale[1], moved[0]],
                                  [-sine * scale[0], cosine * scale[1], moved[1]]])  # fmt: skip
        surface["baseColorTexture"] = use
    kind = one_of("f4", "u1", "u2")
    uvs = random.uniform(-1.5, 2.5, (4, 2)) if kind == "f4" and one_of(True, False) else random.uniform(0, 1, (4, 2))
    uvs = uvs.astype(np.float32) if kind == "f4" else np.round(uvs * np.iinfo(kind).max) / np.iinfo(kind).max
    held["TEXCOORD_0"] = file.values(uvs, kind, normalized=kind != "f4")
    colors = np.ones((4, 3))
    if one_of(True, False):
        kind, width = one_of("f4", "u1", "u2"), one_of(3, 4)
        given_colors = np.concatenate([random.integers(0, 256, (4, 3)) / 255.0, np.full((4, 1), 0.6)], axis=1)
        held["COLOR_0"] = file.values(given_colors[:, :width], kind, normalized=kind != "f4")
        colors = given_colors[:, :3]
    factor = [data.draw(EVENLY) for _ in range(3)] if one_of(True, False) else [1.0] * 3
    if factor != [1.0] * 3:
        surface["baseColorFactor"] = [*factor, 1.0]
    numbers = {key: data.draw(EVENLY) for key in ("metallicFactor", "roughnessFactor") if one_of(True, False)}
    material = file.header["materials"][0]
    material["pbrMetallicRoughness"] = {**surface, **numbers}
    if one_of(True, False):
        held["NORMAL"] = file.values(np.tile([0.0, 0.0, 1.0], (4, 1)))
    for what, names in NAMED.items():
        for name in names:
            if not one_of(False, False, True) or (what == "entry of a sampler" and not textured):
                continue
            if what == "attribute":
                held[name] = file.values(np.zeros((4, 2)))
            elif what == "extension":
                material.setdefault("extensions", {})[name] = {"factor": 1.0}
            else:
                (material if "material" in what else file.header["samplers"][0])[name] = {"x": 1}
            said.add(name)
    mode, indexed = one_of(4, 5, 6), one_of(True, False)
    order = {4: FACES, 5: np.array([0, 1, 3, 2]), 6: np.arange(4)}[mode]
    file.primitive(SQUARE, order if indexed else None, mode=mode, attributes=held)
    if not indexed:
        spread(file, order)
    with tempfile.TemporaryDirectory() as folder:
        (part,), notes = parts_of(file, Path(folder))
    for name in said:
        assert any(name in note for note in notes), (name, notes)
    notes = [note for note in notes if not any(name in note for name in said)]
    assert (part.surface.metallic, part.surface.roughness) == pytest.approx(
        (numbers.get("metallicFactor", 1.0), numbers.get("roughnessFactor", 1.0))
    )
    assert area(part) == pytest.approx([0.0, 0.0, 1.0]) and (part.normals is None) == ("NORMAL" not in held)
    if filter == NEAREST and any(EDGES_NOTE.strip() in note for note in notes):
        return  # enlarged for its hard edges, the picture had no room for what lies far beyond them, which is said
    assert part.flat and part.uvs is not None and not notes
    light = srgb_to_linear(pixels / np.float32(255.0)).astype(np.float64)
    for face in range(len(part.faces)):
        share = random.dirichlet([1.0] * 3)
        place = share @ part.vertices[part.faces[face]]
        corner = [int(np.abs(SQUARE - at).sum(axis=1).argmin()) for at in part.vertices[part.faces[face]]]
        at = transform @ np.append(share @ uvs[corner], 1.0)
        wanted = np.array(factor) * (share @ colors[corner])
        got = np.ones(3) if part.colors is None else share @ part.colors[face]
        inside = part.uvs[part.faces[face]]
        assert place == pytest.approx(share @ SQUARE[corner])
        if textured:
            texels = at * light.shape[1::-1]
            if filter == NEAREST and np.abs(texels - np.round(texels)).min() < 0.02:
                continue  # at a border
            wanted = wanted * reference(light, at[0], at[1], wraps, sharp=filter == NEAREST)
            assert part.surface.texture is not None
            got = got * srgb_to_linear(sample_colors(part.surface.texture, (share @ inside)[None])[0])
        else:
            assert part.surface.color is not None
            got = got * srgb_to_linear(part.surface.color)
        assert got == pytest.approx(wanted, abs=2e-3)


def spread(file: File, order: np.ndarray) -> None:
    """Give the one primitive of a file a vertex for each of its corners."""
    attributes = file.header["meshes"][0]["primitives"][0]["attributes"]
    for accessor in set(attributes.values()):
        entry = file.header["accessors"][accessor]
        view = file.header["bufferViews"][entry["bufferView"]]
        step = view["byteLength"] // entry["count"]
        rows = [file.data[view["byteOffset"] + k * step : view["byteOffset"] + (k + 1) * step] for k in order]
        entry |= {"bufferView": file.view(b"".join(rows), byteStride=step), "count": len(order)}


@pytest.mark.parametrize("kind", ["f4", "u1", "u2"])
@pytest.mark.parametrize("width", [3, 4])
def test_vertex_colors_are_interpolated_in_linear_light(kind: str, width: int, tmp_path: Path) -> None:
    file = File(pbrMetallicRoughness={"metallicFactor": 0.0}, alphaMode="BLEND")
    colors = np.repeat([[0.0], [1.0], [1.0], [0.0]], width, axis=1)
    colors[:, 3:] = 1.0
    file.primitive(attributes={"COLOR_0": file.values(colors, kind, normalized=kind != "f4")})
    asset = import_object(file.write(tmp_path))
    assert len(asset.warnings) == 1 and "baked" in asset.warnings[0]
    share = np.random.default_rng(0).dirichlet([1.0] * 3, 50)
    for face in asset.mesh.faces:
        x = share @ (asset.mesh.vertices[face, 1] + 0.5)
        got = srgb_to_linear(sample_texture(asset.base_color, share @ asset.mesh.uvs[face].astype(np.float64)))
        assert got == pytest.approx(np.repeat(x[:, None], 3, axis=1), abs=0.01)
