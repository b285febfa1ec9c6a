"""`advsearch twins`: reading photographs with poses, rendering their twins, and counting."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from PIL import Image, ImageFilter
from torch import Tensor, nn

import advsearch
from advsearch.errors import InputError
from advsearch.questions.twins import counting, rendering
from advsearch.questions.twins.carry_out import parse_frames
from advsearch.questions.twins.listing import Pinhole, read_photographs
from advsearch.questions.twins.result import COMPOSED, HOLE, TwinPrediction, TwinRow, TwinsResult
from advsearch.registry import get_experiment
from advsearch.report import wording
from advsearch.report.views import get_view, list_remarks
from advsearch.runs import twins as runs_twins
from advsearch.runs.results import IN_PHOTOGRAPH, WITHOUT_OBJECT, Estimate, TwinAgreement, TwinEvidence, TwinMatch
from small_models import SMALL_ATTACK, Finder

pytestmark = pytest.mark.island("advsearch.questions.twins")

PHOTOGRAPHS = Path(__file__).resolve().parents[2] / "scenes" / "photographs"
SCENE = PHOTOGRAPHS / "test" / "000001"


class RedOrBlue(nn.Module):
    """A cup where the middle is redder than blue, else a box."""

    def forward(self, x: Tensor) -> Tensor:
        lead = 20.0 * (x[:, 0] - x[:, 2])[:, 8:24, 8:24].mean(dim=(1, 2))
        return torch.stack([lead, -lead], dim=1)


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> TwinsResult:
    model = advsearch.load_model(RedOrBlue(), labels=["cup", "box"], input_size=32)
    result: TwinsResult = advsearch.twins(
        PHOTOGRAPHS / "photographs.csv",
        network=model,
        environment="studio",
        spp=4,
        run=str(tmp_path_factory.mktemp("twins") / "run"),
    )
    return result


@pytest.mark.medium
def test_twins_stand_where_the_masks_say(compared: TwinsResult, tmp_path: Path) -> None:
    """Masks were drawn from the projected triangles, without the renderer."""
    model = advsearch.load_model(RedOrBlue(), labels=["cup", "box"], input_size=32)
    result = advsearch.twins(
        PHOTOGRAPHS, network=model, names={"obj_000001": "cup", "obj_000002": "box"}, frames="0:3", spp=1,
        environment="studio", run=str(tmp_path / "run"),
    )  # fmt: skip
    assert len(result.pairs) == 4
    assert result.overlap is not None and result.overlap > 0.97
    assert result.low_overlaps == 0


@pytest.mark.medium
def test_the_table_counts_pairs_by_surroundings_and_condition(compared: TwinsResult) -> None:
    total = {row.surroundings: row for row in compared.table if not row.object and not row.condition}
    assert set(total) == {COMPOSED, "studio", HOLE}
    assert {row.pairs for row in total.values()} == {12}
    assert total[COMPOSED].frames == 12
    assert total[COMPOSED].agreement.value > 0.9
    assert total[COMPOSED].photo_right.value == 1.0
    # nothing is wrong, so that no number is stated
    assert total[COMPOSED].kappa is None and total[COMPOSED].wrong_where_twin_wrong is None
    dim = [row for row in compared.table if row.condition == "dim"]
    assert {row.pairs for row in dim} == {4}
    assert all(len(pair.pictures) == 3 for pair in compared.pairs)


@pytest.mark.medium
def test_a_detector_is_judged_by_the_box_of_the_pose(tmp_path: Path) -> None:
    """It sees one box in the middle of the window, where a blue thing is."""
    model = advsearch.load_model(Finder(), labels=["mug", "bowl", "dog"], input_size=32, task="detection")
    result = advsearch.twins(
        PHOTOGRAPHS, network=model, names={"obj_000002": "mug", "obj_000001": "mug"}, frames="0:3", spp=1, margin=0.1,
        task="detection", environment="studio", run=str(tmp_path / "run"),
    )  # fmt: skip
    right = {(pair.row.object, pair.row.photo.right, pair.row.twin(COMPOSED).right) for pair in result.pairs}
    assert right == {("obj_000001", False, False), ("obj_000002", True, True)}
    assert all("box" in json.dumps(pair.row.photo.payload) for pair in result.pairs)


@pytest.mark.medium
def test_a_stored_run_is_read_back_as_it_was(compared: TwinsResult) -> None:
    from advsearch.runs.summary import read_result

    assert compared.run is not None
    assert read_result(Path(compared.run)).to_dict() == compared.to_dict()


def test_the_list_names_what_the_folder_has() -> None:
    folder = read_photographs(PHOTOGRAPHS).objects
    listed = read_photographs(PHOTOGRAPHS / "photographs.csv").objects
    assert len(folder) == len(listed) == 12
    for first, second in zip(folder, listed, strict=True):
        assert first.photograph.samefile(second.photograph)
        assert first.mesh.samefile(second.mesh)
        assert first.pose == pytest.approx(second.pose, abs=1e-4)
        assert first.camera == second.camera
        assert first.unit == second.unit == "mm"
    assert [item.label for item in listed[:2]] == ["cup", "box"]
    assert {item.condition for item in listed} == {"bright", "dim"}


def test_a_window_is_around_the_silhouette_and_in_the_photograph() -> None:
    corners = np.array([[10.0, 20.0], [50.0, 40.0]])
    assert rendering.choose_window(corners, (100, 100), (32, 32), 0.25) == (0, 0, 60, 60)
    assert rendering.choose_window(corners, (100, 100), (32, 32), 0.0) == (10, 10, 40, 40)
    assert rendering.choose_window(corners, (100, 100), (32, 64), 0.0) == (10, 20, 40, 20)
    assert rendering.choose_window(corners + 200.0, (100, 100), (32, 32), 0.0) is None
    assert rendering.choose_window(corners / 40.0, (100, 100), (32, 32), 0.0) is None


@pytest.mark.medium
def test_a_twin_is_the_photograph_where_the_object_is_not_seen(tmp_path: Path) -> None:
    """Beside the silhouette, and where the mask of what is visible ends; noise and blur are left out on request."""
    folder = copy_photographs(tmp_path)
    visible = folder / "test" / "000001" / "mask_visib"
    shutil.copytree(SCENE / "mask", visible)
    levels = np.asarray(Image.open(SCENE / "mask" / "000000_000000.png")).copy()
    rows, columns = np.nonzero(levels)
    middle = int(columns.mean())
    levels[:, middle:] = 0
    Image.fromarray(levels).save(visible / "000000_000000.png")
    item = read_photographs(folder).objects[0]
    window = rendering.PhotoWindow(0, 0, 128, 96)
    photograph = rendering.load_photograph(item.photograph)
    asset = rendering.load_object(item.mesh, item.unit)
    renderer = rendering.LayerRenderer(asset, "mm", "studio", (96, 128), spp=4, seed=0, is_matched=False)
    layer = renderer.render(item, photograph, window, (32, 32))
    composed = np.round(layer.composed.numpy() * 255.0).astype(int)
    is_other = np.abs(composed - photograph.levels).max(axis=2) > 0
    full = np.asarray(Image.open(SCENE / "mask" / "000000_000000.png")) > 0
    near = np.asarray(Image.fromarray(full).filter(ImageFilter.MaxFilter(5)))
    assert not is_other[~near].any() and not is_other[:, middle + 1 :].any()
    assert is_other[full & (np.arange(128) < middle - 1)].mean() > 0.9
    assert layer.alpha[rows, columns].mean() > 0.9, "whether it is hidden or not"
    twin = rendering.make_twin(item, photograph, window, layer, {}, (96, 128))
    assert np.abs(twin.images[HOLE].numpy() * 255.0 - photograph.levels)[:, middle + 2 :].max() < 1e-3
    assert twin.texture_correlation is not None and twin.texture_correlation > 0.5


def test_boxes_of_a_detector_agree_where_they_overlap_by_half() -> None:
    found = {"found": [{"label": "dog", "box": [0, 0, 9, 9]}, {"label": "cup", "box": [0, 0, 4, 2]}]}
    shifted = {"found": [{"label": "cup", "box": [1, 0, 5, 2]}, {"label": "cup", "box": [0, 0, 4, 2]}]}
    far = {"found": [{"label": "cup", "box": [3, 0, 7, 2]}]}
    rows = []
    payloads: list[Any] = [shifted, far, {"found": []}, None]
    for number, payload in enumerate(payloads):
        row = make_row(f"{number}", True, True)
        predictions = [
            prediction.model_copy(update={"payload": value})
            for prediction, value in zip(row.predictions, (found, payload), strict=True)
        ]
        rows.append(row.model_copy(update={"predictions": predictions}))
    # overlaps of 6 of 10, and of 2 of 14
    assert counting.compute_box_iou((0, 0, 4, 2), (1, 0, 4, 2)) == pytest.approx(0.6)
    rate = counting.estimate_box_agreement(rows, "room")
    assert rate is not None and rate.value == pytest.approx(0.5)
    assert counting.estimate_box_agreement(rows[2:], "room") is None


def test_the_texture_is_compared_without_regard_to_brightness() -> None:
    pixels = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    assert rendering.correlate_luminance(pixels, 0.3 * pixels + 0.1) == pytest.approx(1.0, abs=1e-5)
    assert rendering.correlate_luminance(pixels, 1.0 - pixels) == pytest.approx(-1.0, abs=1e-5)
    assert rendering.correlate_luminance(pixels, torch.full((50, 3), 0.5)) is None


def test_frames_are_chosen_by_names_and_ranges() -> None:
    is_used = parse_frames("000002/7, 10:20")
    used = [frame for frame in ("000002/7", "000003/7", "000001/10", "a/21", "b.jpg") if is_used(frame)]
    assert used == ["000002/7", "000001/10"]
    assert parse_frames(None)("anything")
    with pytest.raises(InputError, match="frames: expected a name or a range"):
        parse_frames("1:x")


@pytest.mark.medium
def test_an_attack_states_what_the_run_of_twins_measured(compared: TwinsResult, tmp_path: Path) -> None:
    """Beside the verdict: of the nearest conditions, or that nothing was measured."""
    settings: dict[str, Any] = {**SMALL_ATTACK, "twins": compared.run, "label": "cup"}
    model = advsearch.load_model(RedOrBlue(), labels=["cup", "box"], input_size=32)
    summary = advsearch.attack("mug", model, environment="studio", **settings).summary
    assert summary.twins is not None and summary.twins.row is not None
    assert summary.twins.match is TwinMatch.MEASURED
    assert summary.twins.row.surroundings == "studio" and summary.twins.same_surroundings
    assert not summary.twins.same_object and not summary.twins.row.object
    (remark,) = [text for text in list_remarks(summary, get_view(summary)) if text.startswith("Photographs (")]
    assert "12 pairs of 12 frames" in remark and "Too few renders failed" in remark
    other = advsearch.load_model(RedOrBlue(), labels=["cup", "box"], input_size=32, name="other")
    summary = advsearch.attack("mug", other, environment="studio", **settings).summary
    assert summary.twins is not None and summary.twins.match is TwinMatch.OTHER_MODEL
    assert any("was not measured" in text for text in list_remarks(summary, get_view(summary)))


@pytest.mark.parametrize(
    "names, words",
    [
        ({}, r"photographs.csv: row 1: .*no label 'cup'.*'mug'.* Or name its class with `names`, obj_000001=CLASS"),
        ({"obj_000001": "mug"}, r"photographs.csv: row 2: .*no label 'box'.*obj_000002=CLASS"),
        ({"obj_000001": "mugg"}, r"names: obj_000001: the model has no label 'mugg'. Did you mean 'mug'"),
    ],
)
def test_a_label_that_the_model_does_not_know_is_named_with_its_row(names: dict[str, str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        advsearch.twins(PHOTOGRAPHS / "photographs.csv", model="small_models:easy", names=names)


@pytest.mark.island("advsearch.questions.report", "advsearch.questions.test")
@pytest.mark.medium
def test_sweep_gate_and_evidence_state_what_the_run_of_twins_measured(tmp_path: Path) -> None:
    """Of one run of two models: the row of the model and its environment, and how it is put into words."""
    from advsearch.questions.report.evidence import collect_evidence
    from advsearch.questions.test.settings import SuiteConfig

    model = "small_models:easy"
    twins = advsearch.twins(
        PHOTOGRAPHS / "photographs.csv",
        model=f"small_models:blind,{model}",
        environment="studio",
        spp=1,
        pictures=24,
        names={"obj_000001": "mug", "obj_000002": "vase"},
        run=str(tmp_path / "twins"),
    )
    blind, row = (row for row in twins.table if row.surroundings == "studio" and not row.object and not row.condition)
    # it says the same to all, and half of the photographs are of a mug
    assert (blind.model, blind.agreement.value, blind.wrong_photos, row.model) == ("blind", 1.0, 6, "easy")
    scene: dict[str, Any] = {"environment": "studio", "resolution": 16, "denoise": "none"}
    small: dict[str, Any] = {"trials": 0, "spp": 1, "keep_pictures": "none"}
    run = str(tmp_path / "sweep")
    swept = advsearch.sweep("mug", model, {"camera.azimuth": [20.0, 140.0]}, twins=twins.run, run=run, **scene, **small)
    assert swept.summary.twins is not None and swept.summary.twins.row == row
    claim = {"claim": "right", "at_least": 0.5, "pictures": 8, "settings": {"controls": "camera", "verify_spp": 1}}
    suite = tmp_path / "suite.yaml"
    suite.write_text(
        yaml.safe_dump({"settings": {**scene, "object": "mug", "model": model}, "claims": {"front": claim}})
    )
    gate = get_experiment("test").run(SuiteConfig(suite=str(suite), twins=twins.run, run=str(tmp_path / "gate")))
    assert gate.twins is not None and gate.twins.row == row
    (remark,) = [text for text in list_remarks(gate, get_view(gate)) if text.startswith("Photographs (")]
    pairs = [pair.row for pair in twins.pairs if pair.row.model == "easy"]
    n_agreeing = sum(pair.photo.right == pair.twin("studio").right for pair in pairs)
    assert len(pairs) == 12 and row.agreement.value == pytest.approx(n_agreeing / 12)
    assert f"in {wording.format_estimate(row.agreement)} of 12 pairs of 12 frames" in remark
    evidence, _ = collect_evidence([run])
    assert evidence.runs[0].twins is not None and evidence.runs[0].twins.row == row
    run = str(tmp_path / "unnamed")
    assert advsearch.sweep("mug", model, {"camera.azimuth": [20.0]}, run=run, **scene, **small).summary.twins is None
    evidence, _ = collect_evidence([run], twins=twins.run)
    assert evidence.runs[0].twins is not None and evidence.runs[0].twins.row == row


def make_agreement(**changed: Any) -> TwinAgreement:
    rate = Estimate(value=0.9, interval=(0.8, 0.95))
    fields: dict[str, Any] = {
        "model": "data/net.pt2", "task": "classification", "surroundings": IN_PHOTOGRAPH, "object": "", "condition": "",
        "pairs": 80, "frames": 20, "wrong_photos": 8, "wrong_twins": 10, "both_wrong": 6, "photo_right": rate,
        "twin_right": rate, "agreement": rate, "kappa": None, "margins": None,
        "photo_wrong": Estimate(value=0.1, interval=(0.05, 0.2)),
        "wrong_where_twin_wrong": Estimate(value=0.6, interval=(0.3, 0.85)),
    }  # fmt: skip
    return TwinAgreement(**{**fields, **changed})


def test_the_nearest_conditions_are_those_of_object_and_surroundings(monkeypatch: pytest.MonkeyPatch) -> None:
    table = [
        make_agreement(surroundings=surroundings, object=name)
        for surroundings in (IN_PHOTOGRAPH, "room", WITHOUT_OBJECT)
        for name in ("", "can")
    ]
    monkeypatch.setattr(runs_twins, "read_twins", lambda run: SimpleNamespace(table=table))

    def find(object_name: str, environment: str, **more: Any) -> TwinEvidence:
        evidence = runs_twins.find_twin_evidence(
            "r", model="net.pt2", task="classification", object_name=object_name, environment=environment, **more
        )
        assert evidence is not None
        return evidence

    def describe(evidence: TwinEvidence) -> tuple[Any, ...]:
        assert evidence.row is not None
        return evidence.row.object, evidence.row.surroundings, evidence.same_object, evidence.same_surroundings

    assert describe(find("models/can.ply", "room")) == ("can", "room", True, True)
    assert describe(find("can", "studio")) == ("can", "room", True, False)
    assert describe(find("can", "studio", in_photograph=True)) == ("can", IN_PHOTOGRAPH, True, True)
    assert describe(find("mug", "room")) == ("", "room", False, True)
    text = wording.format_twin_evidence(find("mug", "room", in_photograph=True))
    assert "all objects together, not of this object" in text and ".90 (.80 to .95) of 80 pairs of 20 frames" in text


def make_row(frame: str, photo_right: bool, twin_right: bool) -> TwinRow:
    predictions = [
        TwinPrediction(surroundings=name, label="cup", probability=None, right=right, margin=1.0 if right else -1.0)
        for name, right in (("photograph", photo_right), ("room", twin_right))
    ]
    return TwinRow(
        number=0,
        model="m",
        photograph="",
        frame=frame,
        object="cup",
        label="cup",
        condition="",
        window=(0, 0, 1, 1),
        size=1.0,
        brightness=0.0,
        contrast=0.0,
        texture=None,
        visible=None,
        overlap=None,
        predictions=predictions,
    )


def test_rates_are_counted_by_hand() -> None:
    """Six frames of two rows: twins are wrong in all, photographs in the same row of three of them."""
    rows = []
    for number in range(6):
        rows += [make_row(f"{number}", number >= 3, False), make_row(f"{number}", True, True)]
    row = counting.count_agreement(rows, "room", model="m", task="classification")
    assert (row.pairs, row.frames, row.wrong_photos, row.wrong_twins, row.both_wrong) == (12, 6, 3, 6, 3)
    assert row.agreement.value == pytest.approx(0.75)
    assert row.photo_wrong.value == pytest.approx(0.25)
    assert row.wrong_where_twin_wrong is not None
    assert row.wrong_where_twin_wrong.value == pytest.approx(0.5)
    # photographs are wrong in three frames alone
    assert row.kappa is None


def copy_photographs(tmp_path: Path) -> Path:
    copied = tmp_path / "photographs"
    shutil.copytree(PHOTOGRAPHS, copied)
    return copied


def change_json(file: Path, change: Callable[[Any], None]) -> None:
    content = json.loads(file.read_text("utf-8"))
    change(content)
    file.write_text(json.dumps(content), "utf-8")


WRONG_TRUTHS: dict[str, Callable[[Any], None]] = {
    "obj_id": lambda truths: truths["0"][0].update(obj_id="../../etc/passwd"),
    "the mesh": lambda truths: truths["0"][0].update(obj_id=77),
    "cam_R_m2c: expected 9 numbers": lambda truths: truths["0"][0].update(cam_R_m2c=[1, 2]),
    "expected a rotation": lambda truths: truths["0"][0].update(cam_R_m2c=[2, 0, 0, 0, 2, 0, 0, 0, 2]),
    "z > 0": lambda truths: truths["0"][0].update(cam_t_m2c=[0, 0, -5]),
    "expected finite numbers": lambda truths: truths["0"][0].update(cam_t_m2c=[0, 0, 1e300]),
    "a list of objects": lambda truths: truths.update({"../../x": truths["0"]}),
}


@pytest.mark.parametrize("message", WRONG_TRUTHS)
def test_a_wrong_ground_truth_is_refused(tmp_path: Path, message: str) -> None:
    folder = copy_photographs(tmp_path)
    change_json(folder / "test" / "000001" / "scene_gt.json", WRONG_TRUTHS[message])
    with pytest.raises(InputError, match=message):
        read_photographs(folder)


def test_a_camera_with_skew_is_refused(tmp_path: Path) -> None:
    folder = copy_photographs(tmp_path)
    change_json(
        folder / "test" / "000001" / "scene_camera.json",
        lambda cameras: cameras["3"].update(cam_K=[150, 9, 61, 0, 165, 50, 0, 0, 1]),
    )
    with pytest.raises(InputError, match="image 3: expected a camera without skew"):
        read_photographs(folder)


def test_photographs_that_are_not_there_are_counted(tmp_path: Path) -> None:
    folder = copy_photographs(tmp_path)
    for file in sorted((folder / "test" / "000001" / "rgb").iterdir())[:5]:
        file.unlink()
    listing = read_photographs(folder)
    assert (len(listing.objects), listing.n_missing) == (7, 5)


WRONG_ROWS = {
    "photograph: expected a file in the folder": {"photograph": "../../../../etc/passwd"},
    "object: there is no file": {"object": "models/other.ply"},
    "unit: expected mm": {"unit": "miles"},
    "either K": {"camera": "camera.yaml"},
    "pose: expected 12 or 16 numbers": {"pose": "1 2 3"},
    "expected some of": {"colour": "red"},
}


@pytest.mark.parametrize("message", WRONG_ROWS)
def test_a_wrong_row_of_a_list_is_refused(tmp_path: Path, message: str) -> None:
    row = {
        "photograph": "a.png", "object": "a.ply", "unit": "mm", "K": "100 0 8 0 100 8 0 0 1",
        "pose": "1 0 0 0 0 1 0 0 0 0 1 500",
    }  # fmt: skip
    Image.new("RGB", (16, 16)).save(tmp_path / "a.png")
    (tmp_path / "a.ply").write_bytes((PHOTOGRAPHS / "models" / "obj_000002.ply").read_bytes())
    file = tmp_path / "list.json"
    file.write_text(json.dumps([row]), "utf-8")
    assert read_photographs(file).objects[0].camera == Pinhole(100.0, 100.0, 8.5, 8.5)
    file.write_text(json.dumps([row | WRONG_ROWS[message]]), "utf-8")
    with pytest.raises(InputError, match=message):
        read_photographs(file)


def test_a_list_in_yaml_with_a_camera_file(tmp_path: Path) -> None:
    Image.new("RGB", (32, 16)).save(tmp_path / "a.png")
    photograph = (tmp_path / "a.png").read_bytes()
    # its header has its size, which is all that is needed of it
    (tmp_path / "a.png").write_bytes(photograph[:-20])
    (tmp_path / "a.ply").write_bytes((PHOTOGRAPHS / "models" / "obj_000002.ply").read_bytes())
    camera = (
        "image_width: 32\nimage_height: 16\ncamera_matrix: {rows: 3, cols: 3, data: [40, 0, 15, 0, 41, 7, 0, 0, 1]}"
    )
    (tmp_path / "camera.yaml").write_text(camera, "utf-8")
    row = "{photograph: a.png, object: a.ply, camera: camera.yaml, pose: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 5]}"
    (tmp_path / "list.yaml").write_text(f"photographs:\n- {row}\n", "utf-8")
    (item,) = read_photographs(tmp_path / "list.yaml").objects
    camera_values = (item.camera.fx, item.camera.fy, item.camera.cx, item.camera.cy)
    assert camera_values == pytest.approx((40.0, 41.0, 15.5, 7.5))
    assert item.unit == "m"


def test_what_is_no_data_set_is_refused_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a folder in BOP's form"):
        read_photographs(tmp_path)
    (tmp_path / "list.json").write_text("[" * 500 + "]" * 500, "utf-8")
    with pytest.raises(InputError, match="nested deeper"):
        read_photographs(tmp_path / "list.json")
