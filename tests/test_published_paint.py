"""The script that measures a published camouflage, with a paint that is made up."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks/published_paint.py"


def test_it_asks_for_a_mesh_and_a_paint(capsys: pytest.CaptureFixture[str]) -> None:
    parsed = runpy.run_path(str(SCRIPT))["parsed"]
    with pytest.raises(SystemExit):
        parsed(["--object", "car.obj"])
    assert "--object and --paint are needed" in capsys.readouterr().err
    assert parsed(["--object", "car.obj", "--paint", "a.png"]).samples == 200


@pytest.mark.slow
def test_a_paint_that_hides_is_told_from_the_same_paint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert runpy.run_path(str(SCRIPT))["self_test"]() == 0
    own, red = capsys.readouterr().out.splitlines()[-2:]
    assert "difference +0.0 points" in own
    found = re.search(r"difference (-[0-9.]+) points .95 % interval -[0-9.]+ to -[0-9.]+", red)
    assert found and float(found[1]) < -50.0
