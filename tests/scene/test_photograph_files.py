"""Camera files beside photographs, and folders of photographs among which the control `backdrop` chooses."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import advsearch
import samples
from advsearch.controls import CONTROLS, make_space
from advsearch.controls.backdrop import BackdropControl
from advsearch.engine.loading import fit_camera, make_controls
from advsearch.errors import FileFormatError, InputError
from advsearch.scene import photograph_files
from advsearch.scene.geometry import camera_to_world, compute_object_to_world
from advsearch.scene.photograph_files import read_photograph_folder, read_photograph_view
from advsearch.trust import stored_files

pytestmark = pytest.mark.island("advsearch.controls.backdrop")

BOX = str(samples.PHOTOGRAPHS / "models" / "obj_000002.ply")
NAMES = [f"{number:06d}.jpg" for number in (1, 3, 5, 7, 9, 11)]


def change_json(file: Path, **entries: Any) -> None:
    stated = json.loads(file.read_text("utf-8")) | entries
    file.write_text(json.dumps({key: value for key, value in stated.items() if value is not None}), "utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("folders") / "desk"
    samples.write_photograph_folder(folder)
    return folder


def test_a_camera_file_states_lens_pose_part_and_settings(tmp_path: Path) -> None:
    folder = samples.write_photograph_folder(tmp_path / "desk", set={"ground.size": 0.0, "backdrop.noise": 0.0})
    photograph = folder / NAMES[0]
    scene = advsearch.load_scene(BOX, backdrop=photograph, unit="mm").description
    stated = json.loads(photograph.with_suffix(".json").read_text("utf-8"))
    # the same, stated from Python; no file lies beside the copy
    copy = tmp_path / "copy.jpg"
    copy.write_bytes(photograph.read_bytes())
    settings = {"ground.size": 0.0, "backdrop.noise": 0.0}
    plain = advsearch.load_scene(BOX, backdrop=f"{copy}#16,0,96,96", unit="mm", settings=settings).description
    plain = plain.with_measured_view(stated["camera_matrix"], stated["object_to_camera"])
    assert scene.values == pytest.approx(plain.values) and scene.camera_model and plain.camera_model
    np.testing.assert_allclose(scene.camera_model.intrinsics, plain.camera_model.intrinsics, rtol=1e-12)
    assert scene.backdrop_photograph and scene.backdrop_photograph.crop == (16, 0, 96, 96)
    assert scene.requested == {"ground.size", "backdrop.noise"}, "a control may vary the pose"
    # what the user states wins
    other = advsearch.load_scene(
        BOX, backdrop=f"{photograph}#0,0,64,64", unit="mm", camera="fisheye", settings={"pose.yaw": 7.0}
    ).description
    assert other.camera_model and other.camera_model.name == "fisheye" and other.get_number("pose.yaw") == 7.0
    assert other.backdrop_photograph and other.backdrop_photograph.crop == (0, 0, 64, 64)
    assert other.get_number("pose.x") == scene.get_number("pose.x")


def test_the_first_photograph_is_the_clean_scene_and_one_is_chosen(folder: Path) -> None:
    scene = advsearch.load_scene(BOX, backdrop=folder, unit="mm")
    description = fit_camera(scene.description, 96)
    space = make_space(make_controls("backdrop"), description)
    described = [space.describe(torch.tensor([(place + 0.5) / 6]))["backdrop.which"]["value"] for place in range(6)]
    assert described == NAMES and space.describe(space.start)["backdrop.which"]["value"] == NAMES[0]
    # the object stays, and the camera sees it as it was measured
    for place, view in enumerate(description.photographs.scenes.values()):  # type: ignore[union-attr]
        inputs = space.inputs(torch.tensor([(place + 0.5) / 6]))
        seen = np.linalg.inv(inputs["camera.to_world"].double().numpy()) @ compute_object_to_world(description)
        np.testing.assert_allclose(
            seen, np.linalg.inv(camera_to_world(view)) @ compute_object_to_world(view), atol=1e-5
        )
        gain = description.gain * 2.0 ** float(inputs["camera.exposure"])
        assert gain == pytest.approx(view.gain, rel=1e-5)
    chosen = make_space(make_controls({"backdrop": {"which": NAMES[2:4]}}), description)
    assert chosen.describe(chosen.start)["backdrop.which"]["value"] == NAMES[2]


@pytest.mark.medium
@pytest.mark.parametrize("ground", ["none", "below the object", "at several heights"])
def test_a_photograph_of_a_folder_is_as_that_photograph_alone(tmp_path: Path, ground: str) -> None:
    folder = samples.write_photograph_folder(tmp_path / "desk", set={"ground.size": 0.0 if ground == "none" else 12.0})
    if ground == "at several heights":
        for place, name in enumerate(NAMES):  # and with focal lengths of their own
            file = (folder / name).with_suffix(".json")
            matrix = json.loads(file.read_text("utf-8"))["camera_matrix"]
            matrix[0][0] *= 1.0 + 0.1 * place
            change_json(file, set={"ground.level": -0.2 * place}, camera_matrix=matrix)
    scene = advsearch.load_scene(BOX, "low-sun", backdrop=folder, unit="mm")
    render = scene.renderer({"backdrop": {"which": NAMES[:3]}}, resolution=48)
    for place in (0, 2):
        alone = advsearch.load_scene(BOX, "low-sun", backdrop=folder / NAMES[place], unit="mm")
        expected = alone.renderer("texture", resolution=48)
        with torch.no_grad():
            picture = render(torch.tensor([(place + 0.5) / 3]), 0, 256)
            difference = (picture - expected(expected.start, 1, 256)).abs()
        assert float(difference.mean()) < 0.004 and float(difference.max()) < 0.12, NAMES[place]


def test_a_folder_needs_the_control_and_the_control_a_folder(folder: Path) -> None:
    scene = advsearch.load_scene(BOX, backdrop=folder, unit="mm")
    with pytest.raises(InputError, match="is a folder of photographs; name one of them, or let the control"):
        scene.renderer("texture", resolution=96)
    with pytest.raises(InputError, match=r"chooses among the photographs of a folder.*set `backdrop=FOLDER`"):
        advsearch.load_scene(BOX, backdrop=folder / NAMES[0], unit="mm").renderer("backdrop", resolution=96)
    with pytest.raises(InputError, match=r"has no photograph sofa.jpg; it has 000001.jpg, "):
        scene.renderer({"backdrop": {"which": ["sofa.jpg"]}}, resolution=96)
    with pytest.raises(InputError, match=r"000001.jpg.* has 96 x 96 pixels .* and the rendered picture 96 x 48"):
        scene.renderer("backdrop", resolution=(48, 96))
    with pytest.raises(InputError, match="a mask belongs to one photograph"):
        advsearch.load_scene(BOX, backdrop=folder, unit="mm", occluder="mask.png")
    assert BackdropControl().to_settings() == {}


def test_without_the_control_a_folder_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    others = {name: part for name, part in CONTROLS.built_ins.items() if name != "backdrop"}
    monkeypatch.setattr(CONTROLS, "built_ins", others)
    scene = advsearch.load_scene(BOX, backdrop=folder, unit="mm")
    with pytest.raises(InputError, match=r"is a folder of photographs; name one of them$"):
        scene.renderer("texture", resolution=96)
    with pytest.raises(InputError, match="unknown control 'backdrop'"):
        scene.renderer("backdrop", resolution=96)


def test_photographs_that_can_not_be_chosen_among_are_named(tmp_path: Path) -> None:
    folder = samples.write_photograph_folder(tmp_path / "desk")
    # an object that is turned upside down in one of them
    change_json(folder / "000003.json", up=[0.0, 1.0, 0.0])
    for name in NAMES:
        if name != NAMES[1]:
            change_json((folder / name).with_suffix(".json"), up=[0.0, -1.0, 0.0])
    scene = advsearch.load_scene(BOX, backdrop=folder, unit="mm")
    with pytest.raises(InputError, match=r"in 000003.jpg the object stands on another side than in"):
        scene.renderer("backdrop", resolution=96)
    for name in NAMES:
        change_json(
            (folder / name).with_suffix(".json"), up=None, set={"ground.gloss": 0.04 if name == NAMES[1] else 0.02}
        )
    scene = advsearch.load_scene(BOX, backdrop=folder, unit="mm")
    with pytest.raises(InputError, match=r"in 000003.jpg the plane has another size or gloss \(ground.size, "):
        scene.renderer("backdrop", resolution=96)


@pytest.mark.parametrize("name", ["transforms.json", "images.txt"])
def test_one_file_has_the_cameras_of_a_folder_and_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    photographs = tmp_path / "frames"
    photographs.mkdir()
    frames = []
    lines = []
    for number in range(3):
        file = f"{number}.png"
        Image.new("RGB", (64, 48), (90, 60 * number, 30)).save(photographs / file)
        pose = np.eye(4)
        pose[2, 3] = 1.0 + number
        frames.append({"file_path": f"frames/{file}", "transform_matrix": pose.tolist()})
        # from the world to the camera, whose y is down and z ahead: turned about x by 180 degrees
        lines.append(f"{number} 0 1 0 0 0 0 {1 + number} 7 frames/{file}\n\n")
    lens = {"camera_model": "PINHOLE", "fl_x": 50, "fl_y": 60, "cx": 32, "cy": 24, "w": 64, "h": 48}
    (tmp_path / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    (tmp_path / "images.txt").write_text("".join(lines))
    (tmp_path / "cameras.txt").write_text("7 PINHOLE 64 48 50 60 32 24\n")
    with pytest.raises(FileFormatError, match=r"0.png: expected its camera file .* or set `camera` for all"):
        advsearch.load_scene("mug", backdrop=photographs)
    opened: list[str] = []
    open_regular = stored_files.open_regular

    def open_noted(path: Path, *rest: Any) -> Any:
        opened.append(Path(path).name)
        return open_regular(path, *rest)

    monkeypatch.setattr(stored_files, "open_regular", open_noted)
    scene = advsearch.load_scene("mug", backdrop=photographs, camera=str(tmp_path / name)).description
    assert [file for file in opened if file.endswith((".json", ".txt"))] == (
        [name] if name == "transforms.json" else [name, "cameras.txt"]
    )
    assert scene.photographs and list(scene.photographs.scenes) == ["0.png", "1.png", "2.png"]
    for number, view in enumerate(scene.photographs.scenes.values()):
        height = camera_to_world(view)[:3, 3] * view.size_in_metres
        np.testing.assert_allclose(height, [0.0, 0.0, 1.0 + number], atol=1e-9)
        assert view.camera_model and view.camera_model.intrinsic_by_name["fx"] == 50 / 64
    opened_files = stored_files.list_opened_files(photographs)
    assert str(tmp_path / name) in opened_files, "a run keeps its digest"


def write_text(name: str, text: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).write_text(text, "utf-8")

    return change


def state(**entries: Any) -> Callable[[Path], None]:
    return lambda folder: change_json(folder / "000005.json", **entries)


def link_out(folder: Path) -> None:
    outside = folder.parent / "outside.jpg"
    os.replace(folder / "000005.jpg", outside)
    (folder / "000005.jpg").symlink_to(outside)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda folder: (folder / "000005.json").unlink(), r"000005.jpg: expected its camera file beside it, such as"),
        (write_text("000005.jpg", "no picture"), r"000005.jpg: expected a picture file"),
        (write_text("000005.json", "["), r"000005.json"),
        (link_out, r"000005.jpg: is a link out of its folder"),
        (state(object_to_camera=None), r"000005.json: expected object_to_camera, which 000001.json states"),
        (state(object_to_camera=[1.0] * 11), r"object_to_camera: expected 12 or 16 finite numbers"),
        (state(object_to_camera=[float("nan")] * 12), r"000005.json"),
        (state(object_to_camera=[2.0] * 16), r"000005.json: object_to_camera: expected a rotation"),
        (state(part=[1, 2, 3]), r"part: expected 4 finite numbers"),
        (state(part=[-4, 0, 9, 9]), r"part: expected X, Y, WIDTH, HEIGHT in pixels"),
        (state(part=[100, 0, 96, 96]), r"leaves the photograph"),
        (state(set={"material.roughness": 1.0}), r"set: material.roughness is not about the view"),
        (state(set={"camera.azimut": 1.0}), r"000005.json: .*camera.azimut"),
        (state(set=[1]), r"set: expected settings by name"),
        (state(occluder="../../etc/passwd"), r"occluder: expected a file in its folder or below"),
        (state(up=[0.0, 0.0]), r"up: expected 3 finite numbers"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_folder_is_named(tmp_path: Path, change: Any, message: str) -> None:
    folder = samples.write_photograph_folder(tmp_path / "desk")
    change(folder)
    with pytest.raises(InputError, match=message):
        advsearch.load_scene(BOX, backdrop=folder, unit="mm")


def test_a_folder_is_bounded_and_other_files_are_left_alone(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(FileFormatError, match=r"expected photographs \(.jpg, .*got none"):
        read_photograph_folder(tmp_path)
    copy = samples.write_photograph_folder(tmp_path / "desk")
    (copy / "notes.txt").write_text("not a picture")
    (copy / ".hidden.jpg").write_text("nor this")
    (copy / "masks").mkdir()
    assert list(read_photograph_folder(copy)) == NAMES
    assert read_photograph_view(copy / "other.jpg").spec == str(copy / "other.jpg"), "it has no camera file"
    for limit, value, words in (
        ("MAX_PHOTOGRAPHS", 5, "at most 5 photographs"),
        ("MAX_FILES", 9, "a folder of at most 9 files"),
        ("MAX_FOLDER_PIXELS", 30_000, "photographs of at most 30,000 pixels"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(photograph_files, limit, value)
            with pytest.raises(FileFormatError, match=words):
                read_photograph_folder(folder)
