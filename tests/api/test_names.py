"""Names that nothing is called by are told before anything heavy is imported."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from advsearch.cli.main import main
from advsearch.runs.directory import CONFIG
from advsearch.settings import HEADER

WRONG = """
attack --object mgu --control texture                                       'mug'
attack --object mug --control textur                                        'texture'
attack --object mug --control texture --over camra                          'camera'
attack --object mug --control texture --labels coc0                         'coco90'
attack --object car --environment street --with cra@3,1 --control pose      'car'
sweep --object mug,bowll --grid pose.yaw=0:330:30                           'bowl'
region --object mug --control poze                                          'pose'
explain mug-sweep-01                                                        'mug-sweep-001'
test sute.yaml                                                              suite.yaml
"""


@pytest.mark.parametrize("line", WRONG.strip().splitlines())
def test_a_slip_is_told_with_what_was_meant(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs" / "mug-sweep-001"
    run.mkdir(parents=True)
    (run / CONFIG).write_text(HEADER)
    (tmp_path / "suite.yaml").touch()
    *words, meant = shlex.split(line, posix=False)
    assert main(words) == 2
    said = capsys.readouterr().err
    assert f"id you mean {meant}" in said and "PyTorch" not in said
    assert [one.name for one in (tmp_path / "runs").iterdir()] == ["mug-sweep-001"]
