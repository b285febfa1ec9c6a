"""Objects of Mitsuba scenes keep what their plugins had: each picture beside that of stock Mitsuba."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image

import advsearch
from advsearch.engine.loading import Scene
from advsearch.errors import InputError
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.mitsuba_backend.meshes import make_base_texture, to_repeating_uv
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.scene_files import import_mitsuba_scene
from advsearch.scene.mitsuba_backend.variant import import_mitsuba
from advsearch.scene.mitsuba_backend.writing import write_scene
from covering import once_each

pytestmark = pytest.mark.usefixtures("two_threads")

SIZE, PATCH, SAMPLES = 32, 8, 100
CLOSE = 0.01
"""Mean absolute difference over patches, of displayed values."""

SCENE = f"""<scene version="3.0.0">
  <default name="wrap" value="mirror"/><default name="picture" value="four.png"/>
  <sensor type="perspective"><float name="fov" value="35"/>
    <transform name="to_world"><lookat origin="0.6, 0.5, 2.4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/>
      <rfilter type="box"/></film></sensor>
  <emitter type="constant" id="sky"><rgb name="radiance" value="0.6"/></emitter>
  <emitter type="directional"><vector name="direction" x="-1" y="-1" z="-1"/>
    <rgb name="irradiance" value="1"/></emitter>
"""
RAW = '<boolean name="raw" value="true"/>'
RED = '<rgb name="reflectance" value="0.6, 0.2, 0.1"/>'


def text(key: str, value: str) -> str:
    return f'<string name="{key}" value="{value}"/>'


def to_uv(steps: str) -> str:
    return f'<transform name="to_uv">{steps}</transform>'


def picture(slot: str = "reflectance", file: str = "four.png", more: str = "") -> str:
    return f'<texture type="bitmap" name="{slot}">{text("filename", file)}{more}</texture>'


def attribute(name: str, slot: str = "reflectance") -> str:
    return f'<texture type="mesh_attribute" name="{slot}">{text("name", name)}</texture>'


def bsdf(kind: str, *inner: str) -> str:
    return f'<bsdf type="{kind}">{"".join(inner)}</bsdf>'


def mesh(file: str, *inner: str) -> str:
    return f'<shape type="{file[-3:]}" id="thing">{text("filename", file)}{"".join(inner)}</shape>'


def solid(kind: str, *inner: str) -> str:
    turned = '<transform name="to_world"><scale value="0.5"/><rotate x="1" angle="30"/></transform>'
    return f'<shape type="{kind}" id="thing">{turned}{"".join(inner)}</shape>'


MASK = picture("opacity", "dots.png", RAW)
BUMPS = picture("normalmap", "normals.png", RAW)
SHAPES = {
    "mirrored": mesh("wide.obj", bsdf("diffuse", picture(more=text("wrap_mode", "mirror")))),
    "sharp texels": mesh("slab.obj", bsdf("diffuse", picture(file="dots.png", more=text("filter_type", "nearest")))),
    "defaults": mesh("wide.obj", bsdf("diffuse", picture(file="$picture", more=text("wrap_mode", "$wrap")))),
    "two textures": mesh(
        "slab.obj",
        bsdf(
            "blendbsdf",
            '<float name="weight" value="0.5"/>',
            *(bsdf("diffuse", picture(file=one)) for one in ("four.png", "dots.png")),
        ),
    ),
    "mask and a turned picture": mesh(
        "wide.obj",
        bsdf(
            "mask",
            MASK,
            bsdf("twosided", bsdf("diffuse", picture(more=to_uv('<rotate z="1" angle="30"/><scale value="1.7"/>')))),
        ),
    ),
    "normals and a scaled picture": mesh(
        "slab.obj",
        bsdf("normalmap", BUMPS, bsdf("diffuse", picture(more=to_uv('<scale x="2" y="-3"/><translate x="0.1"/>')))),
    ),
    "bumps": mesh(
        "slab.obj",
        bsdf(
            "bumpmap",
            picture("height", "four.png", RAW),
            '<float name="scale" value="0.05"/>',
            bsdf("diffuse", picture(more=to_uv('<scale value="2"/>'))),
        ),
    ),
    "vertex colours": mesh("grid.ply", bsdf("diffuse", attribute("vertex_color"))),
    "face colours": mesh("grid.ply", bsdf("diffuse", attribute("face_color"))),
    "attribute as weight": mesh(
        "grid.ply", bsdf("blendbsdf", attribute("vertex_shade", "weight"), bsdf("diffuse", RED), bsdf("diffuse"))
    ),
    "flat": mesh("ball.obj", '<boolean name="face_normals" value="true"/>', bsdf("diffuse", RED)),
    "inside out": mesh(
        "ball.obj", '<boolean name="flip_normals" value="true"/>', bsdf("twosided", bsdf("diffuse", RED))
    ),
    "mask without coordinates": mesh("ball.obj", bsdf("mask", MASK, bsdf("diffuse", RED))),
    "upside down": mesh("slab.obj", '<boolean name="flip_tex_coords" value="false"/>', bsdf("diffuse", picture())),
    "linear picture": mesh("slab.obj", bsdf("diffuse", picture(file="light.exr"))),
    "named within another": '<shape type="sphere"><float name="radius" value="0.2"/>'
    '<point name="center" x="0.8" y="0" z="0"/>'
    f'<bsdf type="diffuse" id="paint">{picture()}</bsdf></shape>' + mesh("slab.obj", '<ref id="paint"/>'),
    "instances": '<shape type="shapegroup" id="group"><shape type="sphere"><float name="radius" value="0.2"/>'
    + bsdf("diffuse", picture())
    + '</shape></shape><shape type="instance"><ref id="group"/>'
    '<transform name="to_world"><translate x="0.6" y="0.4"/></transform></shape>'
    + mesh("slab.obj", bsdf("diffuse", picture())),
    "shining": mesh(
        "slab.obj",
        bsdf("diffuse", picture()),
        '<emitter type="area"><rgb name="radiance" value="0.3, 0.2, 0.1"/></emitter>',
    ),
    **{
        f"painted {kind}": solid(kind, bsdf("twosided", bsdf("diffuse", picture())))
        for kind in ("sphere", "cylinder", "cube", "rectangle")
    },
    "red sphere": solid("sphere", bsdf("twosided", bsdf("diffuse", RED))),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Meshes and pictures for all scenes."""
    path = tmp_path_factory.mktemp("scenes")
    chance = np.random.default_rng(0)
    four = np.zeros((16, 16, 3), np.uint8)
    four[:8, :8], four[:8, 8:], four[8:, :8], four[8:, 8:] = (200, 30, 30), (30, 160, 30), (30, 30, 200), (210, 190, 20)
    four[2:4, 2:7] = 250
    Image.fromarray(four).save(path / "four.png")
    Image.fromarray(np.where(chance.random((4, 4, 1)) < 0.5, (20, 20, 20), (220, 120, 60)).astype(np.uint8)).save(
        path / "dots.png"
    )
    across = np.linspace(0.0, 2.0 * np.pi, 16)
    bumps = np.stack(np.broadcast_arrays(np.sin(across)[None, :] * 0.5, np.sin(across)[:, None] * 0.3, 0.8), axis=-1)
    Image.fromarray(((bumps + 1.0) * 127.5).astype(np.uint8)).save(path / "normals.png")
    OpenEXR.File({}, {"RGB": chance.random((4, 4, 3), dtype=np.float32)}).write(str(path / "light.exr"))
    for name, low, high in (("slab", 0.0, 1.0), ("wide", -0.7, 1.6)):
        places = "".join(
            f"v {x} {y} 0\nvt {low if x < 0 else high} {low if y < 0 else high}\n"
            for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
        )
        (path / f"{name}.obj").write_text(f"{places}f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    (path / "ball.obj").write_text("".join(_octahedron()))
    (path / "grid.ply").write_text("".join(_grid(chance)))
    return path


def _octahedron() -> Iterator[str]:
    for axis in range(3):
        for sign in (0.6, -0.6):
            yield "v " + " ".join(str(sign if one == axis else 0.0) for one in range(3)) + "\n"
    for x, y, z in itertools.product((0, 1), repeat=3):
        corners = [1 + x, 3 + y, 5 + z]
        yield "f {} {} {}\n".format(*(corners if (x + y + z) % 2 == 0 else corners[::-1]))


def _grid(chance: np.random.Generator) -> Iterator[str]:
    """A square of 5 x 5 vertices with colours and numbers."""
    yield "ply\nformat ascii 1.0\nelement vertex 25\nproperty float x\nproperty float y\nproperty float z\n"
    yield "".join(f"property float {one}\n" for one in ("color_0", "color_1", "color_2", "shade_0"))
    yield "element face 32\nproperty list uchar int vertex_indices\n"
    yield "".join(f"property float color_{one}\n" for one in range(3)) + "end_header\n"
    for row, column in itertools.product(range(5), repeat=2):
        yield f"{column / 4 - 0.5} {row / 4 - 0.5} {0.1 * (row % 2)} "
        yield f"{column / 4} {row / 4} 0.3 {(row + column) % 3 / 2}\n"
    for row, column in itertools.product(range(4), repeat=2):
        first = 5 * row + column
        for face in ((first, first + 1, first + 6), (first, first + 6, first + 5)):
            yield "3 {} {} {} ".format(*face) + " ".join(map(str, chance.random(3))) + "\n"


def written(folder: Path, name: str, shapes: str) -> Path:
    path = folder / f"{name.replace(' ', '-')}.xml"
    path.write_text(f"{SCENE}{shapes}</scene>")
    return path


def stock(path: Path) -> np.ndarray:
    """The file's picture by Mitsuba alone, as it is displayed."""
    mi = import_mitsuba()
    found = np.array(
        mi.render(mi.load_file(str(path)), integrator=mi.load_dict({"type": "path", "max_depth": 6}), spp=SAMPLES)
    )
    return linear_to_srgb(np.clip(found[..., :3], 0.0, 1.0).astype(np.float32))


def ours(scene: Scene) -> np.ndarray:
    renderer = scene.renderer("pose", resolution=SIZE, denoise="none")
    return np.asarray(renderer(renderer.start, 0, SAMPLES).detach().numpy())


def off(one: np.ndarray, other: np.ndarray) -> float:
    """Mean absolute difference over the patches of two pictures."""
    sides = SIZE // PATCH
    return float(np.abs((one - other).reshape(sides, PATCH, sides, PATCH, 3).mean(axis=(1, 3))).mean())


@pytest.mark.medium
@pytest.mark.parametrize("name", SHAPES)
def test_an_object_looks_as_in_mitsuba(folder: Path, name: str) -> None:
    path = written(folder, name, SHAPES[name])
    scene = advsearch.load_scene(f"{path}#thing")
    theirs = stock(path)
    assert theirs.std() > 0.03, "the object is seen"
    assert off(ours(scene), theirs) < CLOSE
    assert not any("turned over" in one for one in scene.description.notes)


@pytest.mark.medium
def test_it_still_does_when_it_is_written_again(folder: Path, tmp_path: Path) -> None:
    for name in ("vertex colours", "mirrored", "mask and a turned picture", "normals and a scaled picture"):
        path = written(folder, name, SHAPES[name])
        scene = MitsubaScene(advsearch.load_scene(f"{path}#thing").description, (SIZE, SIZE))
        write_scene(scene, {}, tmp_path / "again.xml", "")
        assert off(stock(tmp_path / "again.xml"), stock(path)) < CLOSE, name


@once_each("wrap, filter", ["repeat", "mirror", "clamp"], ["bilinear", "nearest"])
def test_where_a_repeating_texture_shows_the_same(filter: str, wrap: str) -> None:
    """What predicts pictures looks textures up as if they repeated and were interpolated."""
    mi = import_mitsuba()
    chance = np.random.default_rng(0)
    color, uv = chance.random((4, 6, 3), dtype=np.float32), chance.random((100, 2), dtype=np.float32) * 4.0 - 2.0
    turn = np.array([[0.8, -0.6, 0.0, 0.1], [0.6, 0.8, 0.0, 0.2], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    options = {"filter_type": filter, "wrap_mode": wrap, "to_uv": turn}
    at = mi.SurfaceInteraction3f()
    at.uv = mi.Point2f(mi.Float(uv[:, 0]), mi.Float(uv[:, 1]))
    theirs = np.array(mi.load_dict(make_base_texture(color, options)).eval(at)).reshape(3, -1).T
    found = to_repeating_uv(torch.from_numpy(uv), options, (4, 6)).numpy().astype(np.float64)
    linear = np.array(mi.load_dict(make_base_texture(color, {})).eval(_at(found))).reshape(3, -1).T
    np.testing.assert_allclose(linear, theirs, atol=2e-4)


def _at(uv: np.ndarray) -> object:
    mi = import_mitsuba()
    found = mi.SurfaceInteraction3f()
    found.uv = mi.Point2f(mi.Float(uv[:, 0].astype(np.float32)), mi.Float(uv[:, 1].astype(np.float32)))
    return found


def test_a_surface_that_grows_by_its_references_is_refused(folder: Path) -> None:
    levels = "".join(
        f'<bsdf type="blendbsdf" id="b{n}"><float name="weight" value="0.5"/>' + f'<ref id="b{n + 1}"/>' * 2 + "</bsdf>"
        for n in range(30)
    )
    path = written(folder, "bomb", levels + '<bsdf type="diffuse" id="b30"/>' + mesh("slab.obj", '<ref id="b0"/>'))
    with pytest.raises(InputError, match="2000 plugins"):
        import_mitsuba_scene(path, "thing")
