"""The answer of a run under other conditions: what holds, what does not, and beside what clean scene."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

import advsearch
from advsearch.api import replay as replaying
from advsearch.api.attack import attack_once
from advsearch.cli.main import main
from advsearch.config import AttackConfig, ReplayConfig
from advsearch.engine.retrial import Retrials
from advsearch.errors import FileFormatError, InputError
from advsearch.runs.answer import read_answer, write_answer
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Store
from advsearch.runs.summary import read_result
from advsearch.scene.formation import ImageFormation

EASY = "small_models:easy"
SHORT: dict[str, Any] = {
    "object": "mug", "model": EASY, "controls": {"texture": {"epsilon": 0.3}}, "steps": 6, "trials": 6,
    "verify_spp": 4, "spp": 2, "denoise": "none", "baseline": False, "measure": "no", "specialise": False,
}  # fmt: skip


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose answer was found."""
    run = tmp_path_factory.mktemp("replay") / "found"
    assert attack_once(AttackConfig(**SHORT, run=str(run))).found
    return run


def test_an_answer_is_rendered_again_under_every_condition(
    attacked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    monkeypatch.setattr("advsearch.scene.importing.blender.shutil.which", lambda name: None)
    assert main(["replay", str(attacked), "--trials", "6", "--model", "small_models:hard", "--code", EASY, "--run",
                 str(run), "--json", "--quiet"]) == 0  # fmt: skip
    said = json.loads(capsys.readouterr().out)
    rows = {(row["way"], row["condition"]): row for row in said["table"]}
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
        seeds = {tuple(row.seed for row in store.rows(kind)) for kind in store.counts()}
    assert len(seeds) == 1, "the same seeds under every condition"
    assert main(["show", str(run)]) == 0
    text = capsys.readouterr().out
    assert text.startswith("As verified, the answer holds; changed, it holds under ") and "quality 50" in text
    assert "quality 50" in (run / "report.html").read_text("utf-8")


def test_a_replay_goes_on_where_it_was_stopped(attacked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = ReplayConfig(answer=attacked, ways="jpeg", trials=6, run=str(tmp_path / "run"))
    real, done = Retrials._picture, 0

    def stopped(*given: Any) -> Any:
        nonlocal done
        done += 1
        if done == 20:
            raise KeyboardInterrupt
        return real(*given)

    monkeypatch.setattr(Retrials, "_picture", stopped)
    first = replaying.replay_from_config(config)
    assert first.goes_on and len(first.table) == 1
    again = replaying.replay_from_config(config, resumed=tmp_path / "run")
    assert again.ending == "done" and len(again.table) == 4 and done == 20 + 4 * 12 - 19
    assert again.table[0] == first.table[0]


def test_a_run_without_an_answer_is_refused(attacked: Path, tmp_path: Path) -> None:
    with pytest.raises(advsearch.errors.UnknownNameError, match="unknown run"):
        advsearch.replay(tmp_path / "none")
    for name, break_it, message in (
        ("gone", lambda path: path.unlink(), "did the run end"),
        ("short", lambda path: write_answer(path.parents[1], torch.zeros(3).numpy()), "has 3 numbers, and its scene"),
        ("torn", lambda path: path.write_bytes(b"\x93NUMPY"), "expected the answer of a run"),
    ):
        copy = tmp_path / name
        with RunDirectory.create(copy):
            pass
        for file in ("run.yaml", "summary.json", "artifacts/answer.npy"):
            (copy / file).parent.mkdir(exist_ok=True)
            (copy / file).write_bytes((attacked / file).read_bytes())
        break_it(copy / "artifacts" / "answer.npy")
        with pytest.raises((InputError, FileFormatError), match=message):
            advsearch.replay(copy, run=tmp_path / "never")
    assert not (tmp_path / "never").exists()


@pytest.mark.parametrize(
    "header", [b"{'descr': '<f4', 'fortran_order': False, 'shape': (10%b,), }", b"{'shape': '''%b"]
)
def test_a_hostile_header_of_an_answer_is_refused(header: bytes, tmp_path: Path) -> None:
    text = header % (b"0" * 11) + b"\n"
    path = write_answer(tmp_path, torch.zeros(3).numpy())
    path.write_bytes(b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text)
    with pytest.raises(FileFormatError, match=r"answer\.npy: expected numbers"):
        read_answer(tmp_path)


@pytest.mark.parametrize("data", [[[0.5]], [2.0], [float("nan")]], ids=["two axes", "out of range", "nan"])
def test_an_answer_is_a_point_of_the_box(data: Any, tmp_path: Path) -> None:
    write_answer(tmp_path, torch.tensor(data).numpy())
    with pytest.raises(FileFormatError, match=r"expected numbers \(d,\) float32 in \[0, 1\]"):
        read_answer(tmp_path)
    write_answer(tmp_path, torch.tensor([0.25, 1.0]).numpy())
    assert read_answer(tmp_path).tolist() == [0.25, 1.0]


def test_an_unknown_way_is_refused() -> None:
    with pytest.raises(InputError, match="ways: expected some of samples, resolution, depth"):
        ReplayConfig(answer="run", ways="jpeg,fog")


@pytest.mark.parametrize(("curve", "middle"), [("srgb", 0.4613561), ("gamma", 0.4586564), ("reinhard", 0.4268)])
def test_other_tone_curves(curve: str, middle: float) -> None:
    """Grey of 0.18; all of them rise, begin at black and stay within [0, 1]."""
    light = torch.linspace(0.0, 4.0, 401)
    shown = ImageFormation(transfer=curve).display(light)
    assert float(shown[18]) == pytest.approx(middle, abs=1e-3)
    assert bool((shown.diff() >= 0).all()) and float(shown[0]) < 0.002 and float(shown.max()) <= 1.0
