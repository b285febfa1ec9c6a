"""The page about a detector of one's own: its commands are carried out, with a small network in place of the large."""

import json
import shlex
from pathlib import Path

import pytest
from check_docs import DOCS, blocks

from advsearch.cli.main import main
from small_models import Finder, save_exported

pytestmark = pytest.mark.island("all")

PAGE = DOCS / "your-detector.md"
NETWORK = "torchvision:ssdlite320_mobilenet_v3_large"
SMALL = {
    "render": ["--spp", "2", "--denoise", "none"],
    "attack": [
        "--spp",
        "2",
        "--verify-spp",
        "2",
        "--trials",
        "6",
        "--steps",
        "6",
        "--denoise",
        "none",
        "--measure",
        "no",
    ],
    "sweep": ["--samples", "12", "--spp", "2", "--denoise", "none", "--trials", "0"],
}


@pytest.mark.docs
def test_the_steps_can_be_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    save_exported(Finder(), "net.pt2")
    Path("labels.json").write_text(json.dumps(["cup", "bowl", "dog"]), "utf-8")
    commands = [shlex.split(line) for block in blocks(PAGE, "sh") for line in block.splitlines()]
    assert [command[1] for command in commands] == ["render", "attack", "sweep", "export"]
    for command in commands[:-1]:
        assert command[command.index("--model") + 1] == NETWORK
        typed = ["net.pt2" if word == NETWORK else word for word in command[1:]]
        labels = ["--labels", "labels.json"]
        typed = [word for word in typed if word not in ("--steps", "60")]
        assert main([*typed, *labels, *SMALL[command[1]]]) == 0
    assert "cup" in capsys.readouterr().out
    searched, swept = (json.loads(Path(f"runs/{run}/summary.json").read_text("utf-8")) for run in ("first", "average"))
    assert searched["clean"]["label"] == "cup" and searched["ending"] in ("found", "not found", "budget spent")
    assert swept["configurations"] == 12
    assert main(commands[-1][1:]) == 0
    missed = json.loads(Path("missed/annotations.json").read_text("utf-8"))
    assert 0 < len(missed["images"]) < 12 and [one["name"] for one in missed["categories"]] == ["cup", "bowl", "dog"]
    assert Path("mug-prediction.png").is_file() and Path("runs/first/report.html").is_file()
