"""Pictures of runs as datasets: what stands in the files, against the runs themselves, by a reader of its own."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

import advsearch
from advsearch.cli.exporters.dataset.files import find_runs
from advsearch.cli.main import main
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import PARTS, RunDirectory
from advsearch.runs.files import read_png
from advsearch.runs.store import Row
from advsearch.scene.geometry import camera_to_world
from samples import make_attacked
from small_models import easy
from stored_sweeps import rows_of

pytestmark = [pytest.mark.usefixtures("two_threads"), pytest.mark.island("advsearch.cli.exporters.dataset")]

EASY = "small_models:easy"


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mug before which a vase comes, right in some pictures and wrong in others."""
    folder = tmp_path_factory.mktemp("runs") / "suite"
    controls: Any = {"occlusion": {"which": "vase", "coverage": [0.0, 0.7], "direction": [0, 360]}, "camera": {}}
    with RunDirectory.create(folder):
        pass
    advsearch.sweep(
        "mug", EASY, controls=controls, samples=6, spp=2, resolution=32, denoise="none", trials=0,
        run=folder / PARTS / "views", keep_pictures="none",
    )  # fmt: skip
    return folder


def exported(run: Path, out: Path, *more: str, code: str = EASY) -> Any:
    assert main(["export", str(run), "--format", "coco", "--out", str(out), "--code", code, *more]) == 0
    return json.loads((out / "annotations.json").read_text())


def decoded(segmentation: Any) -> npt.NDArray[np.bool_]:
    """The mask of uncompressed runs, which go down the columns, as COCO's paper has them."""
    (height, width), filled, values = segmentation["size"], False, list[bool]()
    for count in segmentation["counts"]:
        values, filled = values + [filled] * count, not filled
    found: npt.NDArray[np.bool_] = np.array(values).reshape(width, height).T
    return found


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_runs_come_back_as_the_mask(share: float) -> None:
    mask = np.random.default_rng(3).random((5, 7)) < share
    counts = find_runs(mask)
    assert sum(counts) == mask.size and all(counts[1:])
    assert (decoded({"size": [5, 7], "counts": counts}) == mask).all()


@pytest.mark.medium
def test_a_sweep_is_what_its_model_saw(swept: Path, tmp_path: Path) -> None:
    found = exported(swept / PARTS / "views", tmp_path / "out", "--all")
    assert found["categories"] == [{"id": k, "name": n, "supercategory": ""} for k, n in enumerate(["mug", "vase"])]
    rows, model = rows_of(swept / PARTS / "views"), easy()
    assert [one["advsearch"]["answers"][0]["row"] for one in found["images"]] == [row.id for row in rows]
    assert [one["id"] for one in found["annotations"]] == list(range(1, len(found["annotations"]) + 1))
    for image, row in zip(found["images"], rows, strict=True):
        picture = torch.from_numpy(read_png(tmp_path / "out" / "images" / image["file_name"]))
        assert picture.shape[:2] == (image["height"], image["width"]) == (32, 32)
        mug, vase = model(picture)[0].tolist()
        assert mug - vase == pytest.approx(row.margin, abs=1e-4)
        assert image["advsearch"]["right"] is row.correct
        assert image["advsearch"]["configuration"]["camera.azimuth"] == row.values["camera.azimuth"]
    for one in found["annotations"]:
        mask = decoded(one["segmentation"])
        y, x = np.nonzero(mask)
        assert one["bbox"] == [x.min(), y.min(), x.max() + 1 - x.min(), y.max() + 1 - y.min()]
        assert one["area"] == mask.sum() and one["iscrowd"] == 0
        if one["category_id"] == 0 and not one["truncated"]:
            hidden = rows[one["image_id"] - 1].values["occlusion.hidden"]["value"]
            assert one["visible_share"] == pytest.approx(1.0 - float(hidden), abs=0.05)
    both = [decoded(one["segmentation"]) for one in found["annotations"] if one["image_id"] == 1]
    assert len(both) == 2 and not (both[0] & both[1]).any()


@pytest.mark.medium
def test_boxes_are_where_vertices_are_projected(tmp_path: Path) -> None:
    grid: Any = {"camera.azimuth": [10.0, 130.0], "camera.elevation": [5.0, 40.0]}
    advsearch.sweep("mug", EASY, grid, spp=1, resolution=(48, 64), denoise="none", trials=0, run=tmp_path / "run")
    found = exported(tmp_path / "run", tmp_path / "out", "--all")
    own = advsearch.load_scene("mug").description
    assert len(found["images"]) == 4
    for image, one in zip(found["images"], found["annotations"], strict=True):
        told = {name: said["value"] for name, said in image["advsearch"]["configuration"].items() if "." in name}
        scene = advsearch.load_scene("mug", settings=told).description
        pose = camera_to_world(scene, 64 / 48)
        x, y, z = ((own.meshes["object"].mesh.vertices @ own.meshes["object"].to_world[:3, :3].T
                    + own.meshes["object"].to_world[:3, 3] - pose[:3, 3]) @ pose[:3, :3]).T  # fmt: skip
        focal = 32.0 / np.tan(np.radians(scene.get_number("camera.fov")) / 2.0)
        across, down = 32.0 - focal * x / z, 24.0 - focal * y / z
        left, top, width, height = one["bbox"]
        got = [left, top, left + width, top + height]
        assert got == pytest.approx([across.min(), down.min(), across.max(), down.max()], abs=1.0)
        assert one["visible_share"] == pytest.approx(1.0, abs=0.01) and one["truncated"] is False


def answered(path: Path, **more: Any) -> Path:
    config = AttackConfig(object="mug", model=EASY, controls={"pose": {}}, resolution=16, denoise="none", **more)
    run = make_attacked(path, config, np.full(6, 0.25))
    with RunDirectory.resume(run) as held:
        for kind, wrong in (("control", False), ("verification", True)):
            held.append_rows(*(Row(kind, k, seed=k, spp=1, correct=not wrong, label="a") for k in range(3)))
    return run


@pytest.mark.medium
def test_yolo_has_a_line_for_each_box(swept: Path, tmp_path: Path) -> None:
    run = swept / PARTS / "views"
    found = exported(run, tmp_path / "coco")
    assert main(["export", str(run), "--format", "yolo", "--out", str(tmp_path / "yolo"), "--code", EASY]) == 0
    assert json.loads((tmp_path / "yolo" / "data.yaml").read_text())["names"] == ["mug", "vase"]
    for image in found["images"]:
        text = (tmp_path / "yolo" / "labels" / image["file_name"]).with_suffix(".txt").read_text()
        lines = [[float(number) for number in line.split()] for line in text.splitlines()]
        own = [one for one in found["annotations"] if one["image_id"] == image["id"]]
        for (label, x, y, width, height), one in zip(lines, own, strict=True):
            box = [32 * (x - width / 2), 32 * (y - height / 2), 32 * width, 32 * height]
            assert label == one["category_id"] and box == pytest.approx(one["bbox"], abs=1e-4)


BESIDE = "car@-1.5,3.5,heading=170,name=oncoming; person@3,-1.2"
CAMERAS = [[14.0, -4.0, 2.5], [9.0, -1.0, 2.0], [7.0, 2.5, 1.5]]
"""Where a camera is at each second, metres from the middle of the car that it looks at: right of it, then before it."""


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A drive towards a car with another one beside it and a person, and its export."""
    folder = tmp_path_factory.mktemp("drive")
    rows = [",".join(map(str, [second, *place])) for second, place in enumerate(CAMERAS)]
    (folder / "way.csv").write_text("\n".join(["time,x,y,z", *rows]))
    advsearch.sweep(
        "car", "small_models:finds_cars", task={"name": "detection", "unit": "fractions"}, label="car", spp=1,
        environment="street", things=BESIDE, path=str(folder / "way.csv"), fps=1,
        resolution=(90, 120), denoise="none", trials=0, run=folder / "run", keep_pictures="none",
    )  # fmt: skip
    exported(folder / "run", folder / "out", "--all", code="small_models:finds_cars")
    return folder / "run", folder / "out"


@pytest.mark.medium
@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # of pycocotools itself
def test_pycocotools_reads_it(driven: tuple[Path, Path]) -> None:
    found = pytest.importorskip("pycocotools.coco").COCO(str(driven[1] / "annotations.json"))
    assert len(found.getImgIds()) == 3 and found.getCatIds(catNms=["car"]) == [1]
    for one in found.loadAnns(found.getAnnIds()):
        assert (found.annToMask(one) == decoded(one["segmentation"])).all()


def seen_by_rays(parts: dict[str, npt.NDArray[np.float64]], size: tuple[int, int], focal: float) -> Any:
    """The name of the part that is nearest at each pixel's middle, of triangles (F, 3, 3) in a camera's space: x left,
    y up, z forward."""
    height, width = size
    nearest, names = np.full(size, np.inf), np.full(size, "", dtype=object)
    for name, triangles in parts.items():
        triangles = triangles[(triangles[:, :, 2] > 0.01).all(axis=1)]
        inverse_depth = 1.0 / triangles[:, :, 2]
        across = width / 2 - focal * triangles[:, :, 0] * inverse_depth
        down = height / 2 - focal * triangles[:, :, 1] * inverse_depth
        for x, y, inverse in zip(across, down, inverse_depth, strict=True):
            doubled = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
            left, right = max(0, int(x.min()) - 1), min(width, int(x.max()) + 2)
            top, bottom = max(0, int(y.min()) - 1), min(height, int(y.max()) + 2)
            if doubled == 0.0 or left >= right or top >= bottom:
                continue
            rows, columns = np.mgrid[top:bottom, left:right] + 0.5
            first = ((x[1] - columns) * (y[2] - rows) - (x[2] - columns) * (y[1] - rows)) / doubled
            second = ((x[2] - columns) * (y[0] - rows) - (x[0] - columns) * (y[2] - rows)) / doubled
            shares = np.stack([first, second, 1.0 - first - second])
            with np.errstate(divide="ignore"):
                depth = np.where((shares >= 0.0).all(axis=0), 1.0 / np.tensordot(inverse, shares, 1), np.inf)
            region = np.s_[top:bottom, left:right]
            names[region] = np.where(depth < nearest[region], name, names[region])
            nearest[region] = np.minimum(depth, nearest[region])
    return names


@pytest.mark.medium
def test_a_drive_has_every_thing_where_rays_meet_it(driven: tuple[Path, Path]) -> None:
    written = json.loads((driven[1] / "annotations.json").read_text())
    scene = advsearch.load_scene("car", "street", things=BESIDE).description
    triangles = {
        name: (part.mesh.vertices @ part.to_world[:3, :3].T + part.to_world[:3, 3])[part.mesh.faces]
        for name, part in scene.meshes.items()
        if name in ("object", "oncoming", "person")
    }
    corners = triangles["object"].reshape(-1, 3)
    middle, metres = (corners.min(axis=0) + corners.max(axis=0)) / 2.0, scene.size_in_metres
    focal = 60.0 / np.tan(np.radians(scene.get_number("camera.fov")) / 2.0)
    seen = set()
    for image, place in zip(written["images"], CAMERAS, strict=True):
        x, y, z = np.array(place) / metres
        eye = middle + np.array([x, y, z])
        forward = (middle - eye) / np.linalg.norm(middle - eye)
        left = np.cross([0.0, 0.0, 1.0], forward)
        left /= np.linalg.norm(left)
        axes = np.stack([left, np.cross(forward, left), forward], axis=1)
        names = seen_by_rays({name: (part - eye) @ axes for name, part in triangles.items()}, (90, 120), focal)
        here = [one for one in written["annotations"] if one["image_id"] == image["id"]]
        assert {one["name"] for one in here} == set(names.ravel()) - {""}
        for one in here:
            mask, true = decoded(one["segmentation"]), names == one["name"]
            rows, columns = np.nonzero(true)
            box = [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]
            assert (mask & true).sum() / (mask | true).sum() > 0.98
            assert one["bbox"] == pytest.approx(box, abs=1.0)
            assert one["category_id"] == (0 if one["name"] == "person" else 1)
            seen |= {(one["name"], one["truncated"])}
    assert seen == {("object", False), ("oncoming", False), ("oncoming", True), ("person", False)}
