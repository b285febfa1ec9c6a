"""Evidence, line by line against the rows of the runs that it is of."""

import json
from collections import Counter
from pathlib import Path

import pytest
from PIL import Image

import advsearch
import samples
import small_models
from advsearch.cli.main import main
from advsearch.questions.explain.result import ExplainResult
from advsearch.questions.report.evidence import collect_claims, evaluate_criterion, list_triggering_conditions
from advsearch.report.wording import percent
from advsearch.runs.store import NAME, Store
from advsearch.statistics.intervals import clopper_pearson
from stored_sweeps import make_sweep

pytestmark = [
    pytest.mark.usefixtures("two_threads"),
    pytest.mark.island("advsearch.questions.report", "advsearch.questions.explain"),
]


@pytest.mark.medium
def test_every_share_is_that_of_the_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    advsearch.sweep(
        "mug", small_models.easy(), {"camera.azimuth": [20.0, 140.0], "camera.elevation": [10.0, 50.0]},
        environment=["studio", "noon"], spp=1, resolution=32, denoise="none", trials=0, run=tmp_path / "run",
        keep_pictures="none",
    )  # fmt: skip
    (tmp_path / "common.yaml").write_text("environment: {studio: 3, noon: 1}\n")
    out = tmp_path / "card"
    asked = ["report", str(tmp_path / "run"), "--evidence", "--out", str(out), "--criterion", "0.5"]
    assert main([*asked, "--exposure", str(tmp_path / "common.yaml"), "--by", "A. N. Other", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    (run,) = told["runs"]
    with Store(tmp_path / "run" / NAME, read_only=True) as store:
        rows = list(store.rows("sweep"))
    right, seen = Counter[tuple[str, str]](), Counter[tuple[str, str]]()
    for row in rows:
        for axis in ("environment", "camera.azimuth", "camera.elevation"):
            value = row.values[axis]["value"]
            key = axis, value if isinstance(value, str) else f"{float(str(value)):g}"
            seen[key] += 1
            right[key] += bool(row.correct)
    counted = {(one["axis"], one["value"]): (one["right"], one["of"]) for one in run["conditions"]}
    assert counted == {key: (right[key], seen[key]) for key in seen} and len(rows) == 8
    for one in run["conditions"]:
        assert one["interval"] == pytest.approx(clopper_pearson(one["right"], one["of"]))
    verdicts = Counter(evaluate_criterion(0.5, tuple(one["interval"])) for one in run["conditions"])
    told_of = f"met in {verdicts['met']}, not met in {verdicts['not met']} and open in {verdicts['open']} of 6."
    assert told_of in run["criterion"][0] and "environment, camera.azimuth, camera.elevation" in run["criterion"][0]
    assert not any(" of 8 " in line for line in run["criterion"]), "no verdict over a grid that somebody chose"
    mean = sum(
        share * right["environment", name] / seen["environment", name]
        for name, share in (("studio", 0.75), ("noon", 0.25))
    )
    (weighted,) = run["exposure"]
    assert f"right in {percent(mean)}, 95 % interval" in weighted and "studio 75 %" in weighted
    for name in run["pictures"]:
        assert (out / name).read_bytes() == (tmp_path / "run" / "images" / name.split("-", 1)[1]).read_bytes()
    assert "bundled object mug" in run["made_with"] and "bundled environment noon" in run["made_with"]


def test_rules_are_claims_and_triggering_conditions_and_say_whether_they_are_confirmed() -> None:
    result = ExplainResult.from_values(samples.EXPLAIN)
    first, *_ = collect_claims(result)
    assert first.kind == "measured" and first.extent is not None and first.extent.total == 97
    assert "camera.elevation over 60 degrees (rule 1)" in first.statement and "fresh renders" in first.statement
    (rule, *_) = samples.EXPLAIN["rules"]
    for confirmed, said in (
        ({**rule["confirmed"], "confirmed": True}, "Confirmed: "),
        ({**rule["confirmed"], "confirmed": False}, "Not confirmed: "),
        (None, "Counted on rows that did not choose it, not rendered: "),
    ):
        told = ExplainResult.from_values({**samples.EXPLAIN, "rules": [{**rule, "confirmed": confirmed}]})
        assert list_triggering_conditions(told)[0].startswith(said)


@pytest.mark.medium
def test_photographs_from_a_folder_agree_by_condition(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, photographs = make_sweep(tmp_path / "run", keep="all"), tmp_path / "photographs"
    photographs.mkdir()
    for name in ("rendering-4", "rendering-6-again"):  # at 45 degrees, right and wrong in the rendering
        Image.new("RGB", (64, 64), (128, 128, 128)).save(photographs / f"{name}.jpg")  # which no model calls a mug
    asked = ["report", str(run), "--evidence", "--photographs", str(photographs), "--json", "--overwrite"]
    for out in ("first", "again"):  # what the run has already is not judged again
        assert main([*asked, "--out", str(tmp_path / out)]) == 0
        (told,) = json.loads(capsys.readouterr().out)["runs"]
        (row,) = told["photographs"]
        assert (row["condition"], row["right"], row["of"]) == ("pose.yaw 45 degrees", 1, 2)
        assert row["interval"] == pytest.approx(clopper_pearson(1, 2))
    (photographs / "rendering-4.jpg").rename(photographs / "front.jpg")
    poses = {"front.jpg,noon,45,10,0.504": 0, "front.jpg,noon,45,10,0.91": 2, "back.jpg,noon,45,10,0.504": 2}
    for line, status in poses.items():
        head = "file,environment,pose.yaw,camera.elevation,light.power"
        (photographs / "poses.csv").write_text(f"{head}\n{line}\n")
        again = make_sweep(tmp_path / line.replace(",", "-"), keep="all")
        assert main(["report", str(again), *asked[2:], "--out", str(tmp_path / "posed")]) == status
        told = capsys.readouterr()
        if status == 0:
            ((one,),) = ([row["of"] for row in run["photographs"]] for run in json.loads(told.out)["runs"])
            assert one == 1
        else:
            assert "line 2" in told.err
