"""Mitsuba's scenes: files and dictionaries with one shape as the object, hostile files, and the picture as it was."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import advsearch
from advsearch.errors import FileFormatError, InputError
from advsearch.scene.mitsuba_backend.scene_files import import_mitsuba_scene, read_contents
from advsearch.scene.mitsuba_backend.shapes import find_haze
from advsearch.scene.mitsuba_backend.variant import import_mitsuba
from advsearch.scene.mitsuba_backend.xml_files import read_scene
from advsearch.scene.parts import PluginPart

pytestmark = pytest.mark.usefixtures("two_threads")

BOX = """<scene version="3.0.0">
  <default name="wide" value="40"/>
  <sensor type="perspective" id="front">
    <float name="fov" value="$wide"/><string name="fov_axis" value="smaller"/>
    <transform name="to_world"><lookat origin="0, 0, 3.9" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="32"/></film>
  </sensor>
  <bsdf type="diffuse" id="white"><rgb name="reflectance" value="0.8, 0.7, 0.6"/></bsdf>
  <shape type="rectangle" id="light">
    <transform name="to_world"><rotate x="1" angle="90"/><scale value="0.4"/><translate y="0.9"/></transform>
    <emitter type="area"><rgb name="radiance" value="8, 8, 7"/></emitter>
  </shape>
  <shape type="rectangle" id="floor">
    <transform name="to_world"><rotate x="1" angle="-90"/><translate y="-1"/></transform><ref id="white"/>
  </shape>
  <shape type="cube" id="largebox">
    <transform name="to_world"><scale value="0.3, 0.6, 0.3"/><rotate y="1" angle="18"/><translate y="-0.4"/></transform>
    <ref id="white"/>
  </shape>
  <shape type="sphere" id="ball">
    <point name="center" x="0.5" y="-0.7" z="0.3"/><float name="radius" value="0.3"/><bsdf type="dielectric"/>
  </shape>
</scene>"""


@pytest.fixture
def box(tmp_path: Path) -> Path:
    path = tmp_path / "box.xml"
    path.write_text(BOX)
    return path


def test_a_file_is_read_as_it_says(box: Path) -> None:
    scene = read_scene(box)
    assert scene["front"]["fov"] == 40.0
    assert scene["white"]["reflectance"] == {"type": "rgb", "value": [0.8, 0.7, 0.6]}
    np.testing.assert_allclose(scene["floor"]["to_world"] @ (0, 0, 1, 1), (0, 0, 0, 1), atol=1e-9)
    ahead = scene["front"]["to_world"] @ (0, 0, 1, 0)
    np.testing.assert_allclose(ahead, (0, 0, -1, 0), atol=1e-9)


def test_the_object_stands_and_the_rest_is_kept(box: Path) -> None:
    found = import_mitsuba_scene(box, "largebox")
    vertices = found.object.mesh.vertices
    assert np.ptp(vertices, axis=0).max() == pytest.approx(1.0)
    assert vertices[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    assert [part.name for part in found.surroundings] == ["white", "light", "floor", "ball"]
    floor = next(part for part in found.surroundings if part.name == "floor")
    assert isinstance(floor, PluginPart)
    matrix = np.asarray(floor.plugin["to_world"])
    np.testing.assert_allclose((matrix @ (0, 0, 0, 1))[2], 0.0, atol=1e-6)  # the box stands on the floor
    assert found.object.surface == {"type": "diffuse", "reflectance": {"type": "base color"}}


def _stock(path: Path) -> np.ndarray:
    """The file's picture by Mitsuba alone, without the first row and column of pixels."""
    mi = import_mitsuba()
    scene = mi.load_file(str(path))
    return np.array(mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 6}), spp=512))


@pytest.mark.medium
@pytest.mark.parametrize("shape", ["largebox", "floor"])
def test_the_picture_is_mitsubas_own(box: Path, shape: str) -> None:
    scene = advsearch.load_scene(f"{box}#{shape}")
    renderer = scene.renderer("pose", resolution=32, denoise="none")
    ours = renderer(renderer.start, 0, 512).detach()
    box.write_text(BOX.replace("</film>", '<rfilter type="box"/></film>'))
    from advsearch.scene.color import linear_to_srgb

    theirs = torch.from_numpy(linear_to_srgb(np.clip(_stock(box), 0.0, 1.0).astype(np.float32)))
    assert float((ours - theirs).abs().mean()) < 0.008
    assert abs(float((ours - theirs).mean())) < 0.001


LAUGHS = "".join(f'<default name="v{n}" value="{f"$v{n - 1}" * 10}"/>' for n in range(1, 12))


@pytest.mark.parametrize(
    "text",
    [
        '<!DOCTYPE scene [<!ENTITY a "b">]><scene version="3.0.0"/>',
        f'<scene version="3.0.0"><default name="v0" value="ha"/>{LAUGHS}</scene>',
        '<scene version="3.0.0">' + "<bsdf type='diffuse'>" * 60 + "</bsdf>" * 60 + "</scene>",
        '<scene version="3.0.0"><include filename="box.xml"/></scene>',
        '<scene version="3.0.0"><include filename="../secret.xml"/></scene>',
        '<scene version="3.0.0"><shape type="ply"><string name="filename" value="../a.ply"/></shape></scene>',
        '<scene version="3.0.0"><bsdf type="../../evil"/></scene>',
        '<scene version="3.0.0"><bsdf type="conductor"><string name="material" value="../x"/></bsdf></scene>',
        '<scene version="3.0.0"><shape type="serialized"><string name="filename" value="a"/></shape></scene>',
        '<scene version="0.5.0"/>',
        '<scene version="3.0.0"><float name="a" value="nan"/></scene>',
        '<scene version="3.0.0"><float name="a" value="$b"/></scene>',
        "<scene",
    ],
)
def test_a_hostile_file_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "secret.xml").write_text('<scene version="3.0.0"/>')
    folder = tmp_path / "inner"
    folder.mkdir()
    path = folder / "box.xml"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=r"\.xml|a\.ply|serialized"):
        read_contents(path)


WRONG = {
    '<shape type="cylinder" id="it"><float name="radius" value="0"/></shape>': "cylinder",
    '<shape type="sphere" id="it"><string name="radius" value="wide"/></shape>': "radius",
    '<shape type="sphere" id="it"><rgb name="center" value="1"/></shape>': "center",
    '<shape type="disk" id="it"><float name="to_world" value="1"/></shape>': "to_world",
    '<shape type="cube" id="it"/><sensor type="perspective"><string name="fov" value="a"/></sensor>': "fov",
}


@pytest.mark.medium
@pytest.mark.parametrize(("inside", "name"), WRONG.items())
def test_a_text_or_nothing_in_the_place_of_a_number_is_refused(tmp_path: Path, inside: str, name: str) -> None:
    path = tmp_path / "a.xml"
    path.write_text(f'<scene version="3.0.0">{inside}<emitter type="constant"/></scene>')
    with pytest.raises(InputError, match=name):
        import_mitsuba_scene(path, "it")


@pytest.mark.parametrize(
    "surface",
    [
        '<bsdf type="roughplastic"><float name="eta" value="1.5"/></bsdf>',
        '<bsdf type="diffuse"><boolean name="reflectance" value="true"/></bsdf>', '<bsdf type="twosided"/>',
    ],
)  # fmt: skip
def test_what_mitsuba_refuses_of_the_objects_own_surface_is_told_too(surface: str, tmp_path: Path) -> None:
    path = tmp_path / "one.xml"
    path.write_text(f'<scene version="3.0.0"><shape type="cube" id="thing">{surface}</shape></scene>')
    with pytest.raises(InputError, match=r"one\.xml#thing"):
        advsearch.load_scene(f"{path}#thing").renderer("pose", resolution=16)


@pytest.mark.parametrize(
    ("changed", "is_haze"),
    [
        ({}, True), ({"ball": {"radius": "wide"}}, False), ({"ball": {"center": [3.0, 0.0, 0.0]}}, False),
        ({"ball": {"bsdf": {"type": "diffuse"}}}, False),
        ({"fog": {"sigma_t": {"type": "rgb", "value": [0.1, 0.2, 0.3]}}}, False),
        ({"fog": {"sigma_t": float("nan")}}, False), ({"fog": {"scale": 0.5}}, True),
        ({"eye": {"medium": {"type": "ref", "id": "mist"}}}, False),
    ],
)  # fmt: skip
def test_haze_is_one_grey_medium_in_a_ball_around_the_camera(changed: dict[str, dict[str, Any]], is_haze: bool) -> None:
    fog: dict[str, Any] = {"type": "ref", "id": "fog"}
    named: dict[str, dict[str, Any]] = {
        "eye": {"type": "perspective", "medium": fog},
        "ball": {"type": "sphere", "radius": 8.0, "bsdf": {"type": "null"}, "interior": fog},
        "fog": {"type": "homogeneous", "sigma_t": 0.1},
    }
    for name, values in changed.items():
        named[name] = {**named.get(name, {}), **values}
    found = find_haze(named, np.diag([0.5, 0.5, 0.5, 1.0]))
    assert (found is not None) == is_haze
    if found is not None:
        haze, used = found
        scale = changed.get("fog", {}).get("scale", 1.0)
        assert (haze.radius, haze.density) == pytest.approx((4.0, 0.2 * scale)) and used == {"ball", "fog"}


@pytest.mark.parametrize("inside", [True, False])
def test_a_medium_is_scaled_with_the_object_wherever_it_stands(inside: bool) -> None:
    smoke: dict[str, Any] = {"type": "homogeneous", "sigma_t": 1.0}
    held: Any = smoke if inside else {"type": "ref", "id": "smoke"}
    cloud = {"type": "sphere", "center": [0, 0, 9], "bsdf": {"type": "null"}, "interior": held}
    scene = {"type": "scene", "box": {"type": "cube"}, "cloud": cloud, **({} if inside else {"smoke": smoke})}
    parts = {
        part.name: part.plugin
        for part in import_mitsuba_scene(scene, "box").surroundings
        if isinstance(part, PluginPart)
    }
    medium: Any = parts["cloud"]["interior"] if inside else parts["smoke"]
    assert medium["scale"] == 2.0  # the cube is 2 wide
