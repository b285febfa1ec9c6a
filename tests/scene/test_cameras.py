"""Cameras with a lens of their own: against OpenCV, from files, inside Mitsuba, and as part of the camera control."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from torch import Tensor

import advsearch
from advsearch.engine.loading import Scene
from advsearch.engine.rendering import make_sight
from advsearch.errors import FileFormatError
from advsearch.scene.camera_files import read_camera
from advsearch.scene.camera_model import NUMBER_NAMES, CameraModel, make_bundled_models, make_pinhole
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.matrix import LinearRenderer
from advsearch.tasks import Facts

HERE = Path(__file__).parent
TABLE: dict[str, Any] = json.loads((HERE / "camera_reference.json").read_text("utf-8"))
WIDTH, HEIGHT = TABLE["width"], TABLE["height"]
PIXELS = torch.tensor([WIDTH, HEIGHT])
HUNDREDTH = 0.01
STILL: dict[str, object] = {"pose": {"yaw": [0, 1]}}

FOLDING = "k1=-0.6"
LENSES = {
    "pinhole": make_pinhole(60.0, 1.0),
    "barrel": make_pinhole(60.0, 1.0).with_intrinsics(
        torch.tensor([0.8, 0.9, 0.5, 0.45, 0.02, -0.28, 0.07, 0.01, *[0.0] * 9])
    ),
    "decentred": make_pinhole(60.0, 1.0).with_intrinsics(
        torch.tensor([0.6, 0.8, 0.51, 0.48, 0.01, 1.2, 0.7, 0.1, 1.5, 0.9, 0.2, 0.003, 0.001, 0.01, -0.02, 0.005, 0.01])
    ),
    FOLDING: make_pinhole(60.0, 1.0).with_intrinsics(torch.tensor([0.7, 0.7, 0.5, 0.5, 0.0, -0.6, *[0.0] * 11])),
    **make_bundled_models(),
}


def ros(model: str, coefficients: list[float], matrix: list[float] | None = None, width: int = WIDTH) -> str:
    return (
        f"image_width: {width}\nimage_height: {HEIGHT}\ncamera_name: front\ndistortion_model: {model}\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {matrix or TABLE['matrix']}}}\n"
        f"distortion_coefficients: {{rows: 1, cols: {len(coefficients)}, data: {coefficients}}}\n"
    )


def pixels(model: CameraModel, points: Tensor) -> Tensor:
    """Where points are seen, from the centre of the first pixel, as OpenCV counts."""
    places, seen = model.project(points)
    assert bool(seen.all())
    return places * PIXELS - 0.5


def grid(side: int = 33) -> Tensor:
    along = torch.linspace(0.0, 1.0, side, dtype=torch.float64)
    return torch.stack(torch.meshgrid(along, along, indexing="xy"), dim=-1).reshape(-1, 2)


@pytest.mark.parametrize("model", list(TABLE["lenses"]))
def test_points_are_seen_where_opencv_sees_them(model: str, tmp_path: Path) -> None:
    lens = TABLE["lenses"][model]
    (tmp_path / "camera.yaml").write_text(ros(model, lens["coefficients"]))
    ours = pixels(read_camera(str(tmp_path / "camera.yaml")), torch.tensor(TABLE["points"], dtype=torch.float64))
    assert float((ours - torch.tensor(lens["pixels"], dtype=torch.float64)).norm(dim=1).max()) < HUNDREDTH


@pytest.mark.parametrize("name", [name for name in LENSES if name != "equirectangular"])
def test_a_ray_is_seen_in_the_place_that_it_comes_from(name: str) -> None:
    directions, inside = LENSES[name].compute_rays(grid())
    places, seen = LENSES[name].project(3.0 * directions)
    assert bool(seen[inside > 0.0].all())
    assert float((places - grid())[inside > 0.0].abs().max()) < 1e-7
    assert bool((inside > 0.0).any())


def test_a_panorama_has_what_is_ahead_in_its_middle_and_the_zenith_on_top() -> None:
    places, _ = make_bundled_models()["equirectangular"].project(
        torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, -1, 0], [-1, 0, -1e-9]])
    )
    torch.testing.assert_close(
        places, torch.tensor([[0.5, 0.5], [0.75, 0.5], [0.5, 0.0], [0.25, 0.5]]).double(), atol=1e-6, rtol=0
    )


def test_a_lens_that_folds_says_at_which_angle_and_is_black_beyond() -> None:
    lens = LENSES[FOLDING]
    assert math.isclose(
        math.degrees(lens.fold_angle_radians), math.degrees(math.atan(math.sqrt(1.0 / 1.8))), rel_tol=1e-6
    )
    assert len(lens.notes) == 1 and "36.7 degrees" in lens.notes[0]
    _, inside = lens.compute_rays(torch.tensor([[0.5, 0.5], [0.0, 0.0]], dtype=torch.float64))
    assert inside[0] > 0.0 > inside[1]


K = [-0.28, 0.07, 0.001, -0.002]
CAMERA_FILES: dict[str, Any] = yaml.safe_load((HERE / "camera_files.yaml").read_text("utf-8"))
"""One camera in the files of each tool, by name, with `#` and its own name where a file has several cameras."""

TEXTS: dict[str, str] = {name: file["text"] for name, file in CAMERA_FILES.items()}


@pytest.mark.parametrize("name", CAMERA_FILES)
def test_one_camera_in_each_kind_of_file_is_the_same(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.with_name(name.partition("#")[0]).write_text(TEXTS[name])
    found = read_camera(str(path))
    assert found.kind == CAMERA_FILES[name]["kind"] and found.calibrated_shape == (720, 1280)
    assert not [note for note in found.reading_notes if "M2" not in note]
    wanted = {"fx": 902.5 / 1280, "fy": 911.75 / 720, "cx": 645.75 / 1280, "cy": 353.0 / 720}
    wanted |= CAMERA_FILES[name]["numbers"]
    assert found.intrinsic_by_name == pytest.approx({**dict.fromkeys(NUMBER_NAMES, 0.0), **wanted})


def test_binned_pixels_are_fewer_and_see_the_same(tmp_path: Path) -> None:
    """Of a width that is no multiple, the last columns are left out; 0 stands for 1."""
    path = tmp_path / "info.yaml"
    path.write_text(GOOD)
    whole = read_camera(str(path))
    path.write_text(GOOD + "binning_x: 3\nbinning_y: 0\n")
    found = read_camera(str(path))
    assert whole.calibrated_shape == (720, 1280) and found.calibrated_shape == (720, 426)
    assert (
        found.intrinsic_by_name["fy"] == whole.intrinsic_by_name["fy"]
        and found.intrinsic_by_name["k1"] == whole.intrinsic_by_name["k1"]
    )
    assert found.intrinsic_by_name["fx"] * 426 * 3 == pytest.approx(whole.intrinsic_by_name["fx"] * 1280)
    assert found.intrinsic_by_name["cx"] * 426 * 3 == pytest.approx(whole.intrinsic_by_name["cx"] * 1280)


@pytest.mark.parametrize(
    ("line", "kind", "numbers"),
    [
        ("SIMPLE_RADIAL_FISHEYE 100 50 40 50 25 0.02", "fisheye", {"fx": 0.4, "fy": 0.8, "k1": 0.02}),
        ("OPENCV_FISHEYE 100 50 40 41 50 25 1 2 3 4", "fisheye", {"fy": 0.82, "k4": 4.0}),
        (
            "FULL_OPENCV 100 50 40 41 50 25 1 2 5 6 3 7 8 9", "brown-conrady",
            {"k3": 3.0, "k4": 7.0, "p1": 5.0, "k6": 9.0},
        ),
        ("EQUIRECTANGULAR 100 50 100 50", "equirectangular", {}),
    ],
)  # fmt: skip
def test_models_of_colmap(line: str, kind: str, numbers: dict[str, float], tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text(f"1 {line}\n")
    found = read_camera(str(tmp_path / "cameras.txt"))
    assert found.kind == kind
    assert {name: found.intrinsic_by_name[name] for name in numbers} == pytest.approx(numbers)


GOOD = ros("plumb_bob", K)
HOSTILE = {
    "empty": "",
    "a tag": "camera_matrix: !!python/object:os.system []\n",
    "no matrix": "image_width: 4\nimage_height: 4\n",
    "no size": GOOD.replace("image_height: 720\n", ""),
    "nan": ros("plumb_bob", [math.nan, 0, 0, 0]),
    "huge": ros("plumb_bob", [1e300, 0, 0, 0]),
    "a huge picture": ros("plumb_bob", K, width=10**9),
    "no focal length": GOOD.replace("902.5", "0.0"),
    "a point outside": GOOD.replace("645.25", "-3.0"),
    "three coefficients": ros("plumb_bob", [1, 2, 3]),
    "a short line": "1 PINHOLE 9 9 1 1\n",
    "several": "1 SIMPLE_PINHOLE 9 9 9 4 4\n2 SIMPLE_PINHOLE 9 9 9 4 4\n",
    "not calibrated": ros("", [], [0.0] * 9),
    "half a pixel": GOOD + "binning_x: 1.5\n",
    "half an XML": "<opencv_storage><image_width>",
    "entities": "<!DOCTYPE a [<!ENTITY b 'c'>]><opencv_storage/>",
    "a part of the picture": GOOD + "roi: {x_offset: 100, y_offset: 0, width: 9, height: 9}\n",
}


@pytest.mark.parametrize("what", list(HOSTILE))
def test_a_file_that_is_no_camera_is_refused_in_a_sentence(what: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(HOSTILE[what])
    with pytest.raises(FileFormatError) as caught:
        read_camera(str(path))
    message = str(caught.value)
    assert str(path) in message and "\n" not in message and len(message) < 700


@pytest.mark.parametrize(
    "text",
    [
        "# Bundle file v0.3\n2 9\n500 0 0\n",
        "[LEFT_CAM_HD]\nfx=700\nfy=700\n",
        TEXTS["metashape.xml"].replace("frame", "cylindrical"),
        TEXTS["metashape.xml"].replace("<date>", "<k4>0.1</k4><date>"),
        TEXTS["metashape_fisheye.xml"].replace("<date>", "<p1>0.1</p1><date>"),
        "model_type: SCARAMUZZA\nimage_width: 9\n",
        ros("fov", [0.9]),
        "cam0: {camera_model: eucm, intrinsics: [1, 2, 3, 4, 5, 6]}\n",
        "a: {projection_type: dual, width: 4, height: 4}\n",
        "a: {projection_type: brown, width: .nan, height: 4}\n",
        "a: {projection_type: brown, height: 4}\n",
        TEXTS["calib.txt#P0"].replace("image_width: 1280\n", ""),
        "P2: 7 0 6 0 0 7 3 0 0 0 1 0\n",
        "P2: 7 0 6 0 0 x 3 0 0 0 1 0\nimage_width: 9\nimage_height: 9\n",
        TEXTS["kb8.yaml"].replace("KannalaBrandt8", "KannalaBrandt9"),
    ],
)  # fmt: skip
def test_files_of_other_tools_that_are_not_read_are_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=r"camera\.yaml"):
        read_camera(str(path))


def scene_with(model: CameraModel) -> Scene:
    """The mug through a lens that no file has."""
    return Scene(replace(advsearch.load_scene("mug").description, camera_model=replace(model, name="test")))


def rays_of(scene: MitsubaScene, places: Tensor) -> tuple[Tensor, Tensor]:
    """Directions of Mitsuba's rays in the camera's coordinates, and which of them see something."""
    import mitsuba as mi

    sensor = scene.set_inputs({}).sensors()[0]
    columns = mi.Point2f(places.T.float().contiguous().numpy())
    ray, weight = sensor.sample_ray(0.0, 0.5, columns, mi.Point2f(0.5))
    local = sensor.world_transform().inverse() @ ray.d
    directions = torch.stack([one.torch() for one in local], dim=1).cpu().double()
    return directions * torch.tensor([-1.0, -1.0, 1.0]), weight.x.torch().cpu() > 0.0


@pytest.mark.parametrize("name", ["barrel", "decentred", "fisheye"])
def test_rays_inside_mitsuba_are_those_of_the_model(name: str) -> None:
    side, model = 64, LENSES[name]
    places = torch.rand(2000, 2, generator=torch.Generator().manual_seed(3))
    directions, seen = rays_of(MitsubaScene(scene_with(model).description, (side, side)), places)
    found, _ = model.project(directions)
    off = side * (found - places.double()).norm(dim=1)[seen]
    assert float(off.quantile(0.99)) < HUNDREDTH
    assert torch.equal(seen, model.compute_rays(places)[1] > 0.0)


@pytest.fixture(scope="module")
def through_fisheye() -> Renderer:
    scene = advsearch.load_scene("mug", camera="fisheye")
    return scene.renderer({"texture": {"resolution": 32}}, resolution=32)


def test_the_object_is_seen_where_the_model_projects_it(through_fisheye: Renderer) -> None:
    """The mask, and with it the box that a detector should find."""
    rows, columns = torch.nonzero(through_fisheye.compute_object_mask(through_fisheye.start), as_tuple=True)
    description = through_fisheye.scene.description_and_filter[0]
    pose = torch.from_numpy(camera_to_world(description))
    vertices = torch.from_numpy(description.base_vertices)
    points = (vertices - pose[:3, 3]) @ pose[:3, :3] * torch.tensor([-1.0, -1.0, 1.0])
    places, _ = make_bundled_models()["fisheye"].project(points)
    low, high = 32 * places.amin(dim=0), 32 * places.amax(dim=0)
    seen = torch.stack([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]).double()
    assert float((seen - torch.cat([low, high])).abs().max()) < 1.0


def test_outside_the_circle_all_is_black_in_pictures_guides_and_predictions(through_fisheye: Renderer) -> None:
    u, corner = through_fisheye.start, (slice(0, 4), slice(0, 4))
    with torch.no_grad():
        traced = through_fisheye.radiance(u, 1, 16)
        predicted = LinearRenderer(through_fisheye, u, seed=1).renderer.radiance(u)
    albedo, normal = through_fisheye.scene.render_guides({}, 0, 4)
    for picture in (through_fisheye.scene.render_radiance({}, 1, 4), albedo, normal):
        assert float(picture[corner].abs().max()) == 0.0
    for picture in (traced, predicted):
        assert float(picture[corner].abs().max()) < 1e-3, "the denoiser leaves a little"
    assert float(traced[16, 16].mean()) > 0.05
    assert not bool((through_fisheye.find_surfaces(u).id[corner] > 0).any())
    off = (predicted - traced).abs().mean() / traced.abs().mean()
    assert float(off) < 0.1, "the predicted picture is seen along the same rays"


@pytest.mark.medium
def test_a_searched_lens_is_the_fixed_one_and_has_a_derivative() -> None:
    scene = advsearch.load_scene("mug")
    searched = scene.renderer({"camera": {"k1": [-0.4, 0.4], "fov": 60}}, resolution=24, denoise="none")
    fixed = scene.renderer({"camera": {"k1": -0.2, "fov": 60}, **STILL}, resolution=24, denoise="none")
    with torch.no_grad():
        bent, straight = searched([0.25], 3, 16), searched([0.5], 3, 16)
        assert float((bent - fixed(fixed.start, 3, 16)).abs().max()) < 1e-4
        assert float((bent - straight).abs().mean()) > 0.003
    u = torch.tensor([0.25], requires_grad=True)
    searched(u, 3, 16).mean().backward()
    assert u.grad is not None and float(u.grad.abs()) > 0.0


BARREL = "barrel of a file"
BOXED = {
    BARREL: {"camera.distance": 1.05},
    "fisheye": {"camera.distance": 0.85},
    "equirectangular": {"camera.distance": 0.85},
}


@pytest.mark.parametrize("camera", list(BOXED))
def test_truth_is_that_of_the_distorted_picture(camera: str, tmp_path: Path) -> None:
    """The mask and the box that a detector is judged by are where the object's paint shows, and no pinhole's."""
    path = tmp_path / "camera.yaml"
    path.write_text(ros("plumb_bob", [-0.6, 0.0, 0.0, 0.0], [500.0, 0.0, 760.0, 0.0, 280.0, 300.0, 0.0, 0.0, 1.0]))
    seen_by = str(path) if camera == BARREL else camera
    scene = advsearch.load_scene("mug", camera=seen_by, size=1.0, settings=BOXED[camera])
    one = scene.renderer({"texture": {"resolution": 2, "epsilon": 1.0}}, resolution=48, denoise="none")
    with torch.no_grad():
        white, black = (one.radiance(torch.full_like(one.start, value), 1, 32) for value in (1.0, 0.0))
    painted = (white - black).mean(dim=-1) > 0.15 * float((white - black).mean(dim=-1).max())
    truth = make_sight(one.find_surfaces(one.start))
    seen = Facts("mug", compute_sight=lambda: truth)
    shown = Facts("mug", compute_sight=lambda: replace(truth, mask=painted))
    assert seen.box is not None and shown.box is not None
    assert max(abs(a - b) for a, b in zip(seen.box, shown.box, strict=True)) <= 1
    assert float((seen.mask & painted).sum()) > 0.85 * float((seen.mask | painted).sum())
    plain = replace(scene.description, camera_model=None)
    pose = camera_to_world(scene.description)
    flat = (plain.base_vertices - pose[:3, 3]) @ pose[:3, :3] * (-1.0, -1.0, 1.0)
    model = scene.description.camera_model
    assert model is not None
    fx, fy, cx, cy = model.intrinsics[:4]
    straight = 48 * (flat[:, :2] / flat[:, 2:] * (fx, fy) + (cx, cy))
    ends = (*straight.min(axis=0), *straight.max(axis=0))
    assert max(abs(a - b) for a, b in zip(seen.box, ends, strict=True)) > 2.5, "a pinhole's box is another one"
