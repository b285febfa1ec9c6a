"""The answer of a run under other conditions: what holds, what does not, and beside what clean scene."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

import advsearch
import samples
from advsearch.cli.main import main
from advsearch.engine.problem import Problem
from advsearch.errors import FileFormatError, InputError
from advsearch.questions.attack.run import attack_once
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.replay import replay
from advsearch.questions.replay.result import PHOTOGRAPH, ReplayConfig, ReplayRow, count_transfer, describe_transfer
from advsearch.runs.store import Store
from advsearch.runs.summary import read_configuration, read_result, write_configuration

pytestmark = pytest.mark.island("advsearch.questions.replay")

EASY = "small_models:easy"
SHORT: dict[str, Any] = {
    "object": "mug", "model": EASY, "controls": {"texture": {"epsilon": 0.3}}, "steps": 6, "trials": 6,
    "verify_spp": 4, "spp": 2, "denoise": "none", "baseline": False, "measure": "no",
    "resolution": 32,
}  # fmt: skip


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose answer was found."""
    run = tmp_path_factory.mktemp("replay") / "found"
    assert attack_once(AttackConfig(**SHORT, run=str(run))).found
    return run


@pytest.mark.medium
def test_an_adversarial_scene_is_rendered_again_under_every_condition(
    attacked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    monkeypatch.setattr("shutil.which", lambda name: None)
    assert main(["replay", str(attacked), "--trials", "6", "--model", "small_models:hard", "--code", EASY, "--run",
                 str(run), "--json", "--quiet"]) == 0  # fmt: skip
    said = json.loads(capsys.readouterr().out)
    rows = {(row["change"], row["condition"]): row for row in said["table"]}
    assert {way for way, _ in rows} == {
        "as verified", "samples", "resolution", "depth", "integrator", "sampler", "denoiser", "curve", "jpeg", "sensor",
        "blender", "model",
    }  # fmt: skip
    without = rows.pop(("blender", "Cycles, Blender's renderer"))
    assert without["ending"] == "not done" and "none is installed" in without["reason"] and "clean" not in without
    said["table"].remove(without)
    assert all(row["clean"]["trials"] == row["verified"]["trials"] == 6 for row in said["table"])
    assert rows["as verified", "as verified"]["ending"] == "found", "what was verified holds in fresh pictures too"
    assert rows["samples", "16 a pixel"]["verified"]["spp"] == 16 and ("samples", "1 a pixel") in rows
    assert ("resolution", "16 x 16 pixels") in rows and ("resolution", "64 x 64 pixels") in rows
    assert rows["integrator", "Mitsuba's path in place of prb"]["ending"] == "found"
    assert read_result(run).to_dict() == {**said, "table": [*said["table"][:-1], without, said["table"][-1]]}
    with Store(run / "results.sqlite", read_only=True) as store:
        seeds = {tuple(row.seed for row in store.rows(kind)) for kind in store.count_by_kind()}
    assert len(seeds) == 1, "the same seeds under every condition"


@pytest.mark.medium
def test_a_replay_goes_on_where_it_was_stopped(attacked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = ReplayConfig(attack=attacked, ways="jpeg", trials=6, run=str(tmp_path / "run"))
    real, done = Problem.judge, 0

    def stopped(*given: Any) -> Any:
        nonlocal done
        done += 1
        if done == 32:  # 4 conditions x 6 of the clean scene, 6 of the answer, and one more
            raise KeyboardInterrupt
        return real(*given)

    monkeypatch.setattr(Problem, "judge", stopped)
    first = replay.run(config)
    assert first.is_unfinished and len(first.table) == 1
    again = replay.run(config, resumed_directory=tmp_path / "run")
    assert again.ending == "done" and len(again.table) == 4 and done == 32 + 4 * 12 - 31
    assert again.table[0] == first.table[0]


@pytest.mark.medium
def test_a_file_that_has_changed_since_is_said(tmp_path: Path) -> None:
    names = tmp_path / "names.json"
    names.write_text('["mug", "vase"]')
    attack_once(AttackConfig(**SHORT, labels=str(names), label="mug", run=str(tmp_path / "found")))
    same = advsearch.replay(tmp_path / "found", ways="sampler", trials=6, run=tmp_path / "same")
    assert not any("names.json" in one for one in same.warnings)
    names.write_text('["mug", "bowl"]')
    other = advsearch.replay(tmp_path / "found", ways="sampler", trials=6, run=tmp_path / "other")
    assert any("names.json is not what it was when the run was made" in one for one in other.warnings)


@pytest.mark.medium
def test_what_changes_only_after_rendering_renders_nothing(attacked: Path, tmp_path: Path) -> None:
    together = advsearch.replay(
        attacked, ways="curve,jpeg,sensor,sampler", model="small_models:hard", trials=6, run=tmp_path / "together"
    )
    assert together.renders == 2 * 6 * 2, "as verified and the other sampler; each of the clean scene and the answer"
    assert len(together.table) == 10 and together.table[-1].condition == "small_models:hard"
    (_, alone) = advsearch.replay(attacked, ways="sampler", trials=6, run=tmp_path / "sampler").table
    assert alone == together.table[1], "rows are in the order of the conditions"


def make_rows(**counts: int) -> list[ReplayRow]:
    """Return rows of photographs by status, and one of another condition that holds."""
    endings = [ending.replace("_", " ") for ending, count in counts.items() for _ in range(count)]
    rows = [
        ReplayRow(change=PHOTOGRAPH, condition=f"{index}.jpg", ending=ending) for index, ending in enumerate(endings)
    ]
    return [ReplayRow(change="as verified", condition="as verified", ending="found"), *rows]


def test_photographs_are_counted_where_the_clean_scene_is_right() -> None:
    assert count_transfer(make_rows()) is None
    transfer = count_transfer(make_rows(found=3, already_wrong=2, not_verified=5, not_done=4))
    assert transfer and transfer.rate and transfer.rate.interval
    assert (transfer.photographs, transfer.clean_right, transfer.holding) == (10, 8, 3)
    # Clopper and Pearson's interval of 3 in 8, from a table
    assert transfer.rate.interval == pytest.approx((0.0852, 0.7551), abs=1e-4)
    assert describe_transfer(transfer) == (
        "It was tried in 10 other photographs: the clean scene is right in 8 of them, and of these it holds in 3 (38%, "
        "95 % interval 9-76 %)."
    )
    wrong = count_transfer(make_rows(already_wrong=2))
    assert wrong and wrong.rate is None and "right in 0 of them, so that they say nothing" in describe_transfer(wrong)


@pytest.mark.medium
def test_a_texture_of_a_room_is_tried_in_photographs(tmp_path: Path) -> None:
    folder = samples.write_photograph_folder(tmp_path / "desk", set={"ground.size": 0.0})
    box = str(samples.PHOTOGRAPHS / "models" / "obj_000002.ply")
    settings = {
        "object": box,
        "unit": "mm",
        "label": "mug",
        "controls": {"texture": {"epsilon": 0.8}},
        "steps": 8,
        "resolution": 48,
        "spp": 4,
    }
    in_room = {"environment": "room", "set": {"camera.azimuth": 40.0}, "over": {"camera": {"roll": [0, 9]}}}
    in_photograph = {"backdrop": str(folder / "000001.jpg")}
    transfers = []
    for name, scene in (("room", in_room), ("photograph", in_photograph)):
        run = tmp_path / name
        attack_once(AttackConfig(**SHORT | settings | scene, run=str(run)))
        replayed = advsearch.replay(run, backdrop=folder, trials=6, run=tmp_path / f"{name}-replay")
        assert [row.change for row in replayed.table[1:]] == [PHOTOGRAPH] * (len(replayed.table) - 1)
        assert replayed.transfer is not None
        transfers.append(replayed.transfer)
    assert [transfer.photographs for transfer in transfers] == [6, 5], "not in the photograph that was searched"
    assert all(transfer.holding <= transfer.clean_right <= transfer.photographs for transfer in transfers)
    with pytest.raises(InputError, match="expected a folder of photographs with their camera files"):
        advsearch.replay(tmp_path / "room", backdrop=folder / "000001.jpg", trials=6, run=tmp_path / "none")


@pytest.mark.parametrize(
    "header", [b"{'descr': '<f4', 'fortran_order': False, 'shape': (10%b,), }", b"{'shape': '''%b"]
)
def test_a_hostile_header_of_a_configuration_is_refused(header: bytes, tmp_path: Path) -> None:
    text = header % (b"0" * 11) + b"\n"
    path = write_configuration(tmp_path, torch.zeros(3).numpy())
    path.write_bytes(b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text)
    with pytest.raises(FileFormatError, match=r"adversarial\.npy: expected numbers"):
        read_configuration(tmp_path)
