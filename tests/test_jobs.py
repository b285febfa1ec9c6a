"""Whole commands, each a job that a user does, at the smallest sizes: `make test` runs them with the quick tests.

They share one run of an attack and one of a sweep, as users read what they have computed.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from advsearch.cli.main import main

SMALL = ("--resolution", "32", "--spp", "2")
CODE = ("--code", "small_models:easy")
FEW = ("--steps", "2", "--trials", "6", "--measure", "no", *SMALL)


def run_command(*arguments: str | Path, status: int = 0) -> None:
    """Run a command in this process and check its exit status."""
    assert main([str(argument) for argument in arguments]) == status


@pytest.fixture(scope="module")
def attack_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an attack on the texture of the mug, which finds a failure."""
    run = tmp_path_factory.mktemp("jobs") / "attack-run"
    texture = ("--control", "texture={epsilon: 0.5, resolution: 16}", "--model", "small_models:easy")
    run_command("attack", "--object", "mug", *texture, *FEW, "--run", run)
    return run


@pytest.fixture(scope="module")
def sweep_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a sweep over six views of the mug."""
    run = tmp_path_factory.mktemp("jobs") / "sweep"
    run_command(
        "sweep", "--object", "mug", "--grid", "pose.yaw=0,60,120,180,240,300", "--trials", "0", *SMALL, "--run", run
    )
    return run


def load_summary(run: Path) -> dict[str, object]:
    """Return the stored summary of a run."""
    result: dict[str, object] = json.loads((run / "summary.json").read_text("utf-8"))
    return result


def test_attack_texture(attack_run: Path) -> None:
    assert {"run.yaml", "summary.json", "report.html"} <= {path.name for path in attack_run.iterdir()}
    assert load_summary(attack_run)


ATTACKS: dict[str, Sequence[str]] = {
    "pose at random": ("--control", "pose", "--policy", "random"),
    "pose by evolution": ("--control", "pose", "--policy", "cmaes"),
    "light by gradient": ("--control", "light", "--policy", "pgd"),
    "geometry": ("--control", "geometry"),
    "environment": ("--control", "environment"),
    "patch over conditions": ("--control", "patch", "--over", "camera", "--draws", "2"),
    "smallest change": ("--control", "texture={resolution: 4}", "--smallest"),
    "an average": ("--control", "pose", "--average", "4"),
    "a detector": ("--control", "light", "--task", "detection", "--model", "small_models:finder"),
}


NEEDED = {"patch over conditions": pytest.mark.island("advsearch.controls.patch")}
"""What an attack needs beyond the core."""


@pytest.mark.parametrize(
    "job",
    [pytest.param(job, marks=NEEDED.get(job, ())) for job in ATTACKS],
    ids=lambda job: job.replace(" ", "-"),
)
def test_attack(job: str, tmp_path: Path) -> None:
    run_command("attack", "--object", "mug", *ATTACKS[job], *FEW, "--run", tmp_path / "run")
    assert load_summary(tmp_path / "run")


def test_sweep(sweep_run: Path) -> None:
    assert load_summary(sweep_run)


def test_show(attack_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_command("show", attack_run)
    assert "mug" in capsys.readouterr().out


def test_resume_of_a_finished_run(attack_run: Path) -> None:
    run_command("resume", attack_run)


def test_runs(attack_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_command("runs", attack_run.parent)
    assert "attack" in capsys.readouterr().out


def test_view(sweep_run: Path, tmp_path: Path) -> None:
    run_command("view", sweep_run, "--bundle", tmp_path / "site")
    assert list((tmp_path / "site").rglob("*.html"))


def test_export_rows(sweep_run: Path, tmp_path: Path) -> None:
    run_command("export", sweep_run, "--format", "csv", "--out", tmp_path / "rows.csv")
    assert len((tmp_path / "rows.csv").read_text("utf-8").splitlines()) == 7


@pytest.mark.island("advsearch.cli.exporters.scene")
def test_export_mesh(attack_run: Path, tmp_path: Path) -> None:
    run_command("export", attack_run, "--format", "gltf", *CODE, "--out", tmp_path / "object.glb")
    assert (tmp_path / "object.glb").read_bytes()[:4] == b"glTF"


@pytest.mark.island("advsearch.questions.replay")
def test_replay(attack_run: Path, tmp_path: Path) -> None:
    run_command("replay", attack_run, "--ways", "samples,jpeg", "--trials", "6", *CODE, "--run", tmp_path / "replay")


def test_render(tmp_path: Path) -> None:
    import imageio.v3 as imageio

    run_command("render", "--object", "mug", "--out", tmp_path / "image.png", *SMALL)
    image = imageio.imread(tmp_path / "image.png")
    assert image.shape[:2] == (32, 32) and np.ptp(image) > 50


def test_import(tmp_path: Path) -> None:
    mesh = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "solid.obj").write_text(mesh)
    run_command("import", tmp_path / "solid.obj")


@pytest.mark.island("advsearch.questions.compare")
def test_compare(tmp_path: Path) -> None:
    suite = ("--object", "mug", "--control", "pose", "--samples", "3", *SMALL)
    run_command("compare", "reference", "small_models:easy", *suite, "--run", tmp_path / "compare")


@pytest.mark.island("advsearch.questions.test")
def test_test(tmp_path: Path) -> None:
    claim = "{claim: right, at_least: 0.5, pictures: 100, settings: {controls: light}}"
    settings = "{object: mug, model: small_models:easy, resolution: 32}"
    (tmp_path / "claims.yaml").write_text(f"settings: {settings}\nseed: 0\nclaims:\n  lit: {claim}\n")
    run_command("test", tmp_path / "claims.yaml", *CODE, "--run", tmp_path / "gate")


@pytest.mark.island("advsearch.questions.check")
def test_check(tmp_path: Path) -> None:
    run_command(
        "check",
        "--object",
        "mug",
        "--control",
        "light.power",
        "--loss",
        "linear",
        "--resolution",
        "32",
        "--run",
        tmp_path / "check",
    )


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    run_command("list", "controls")
    assert "texture" in capsys.readouterr().out


def test_a_name_that_is_not_there_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    run_command("attack", "--object", "mugg", "--control", "texture", status=2)
    assert "mug" in capsys.readouterr().err
