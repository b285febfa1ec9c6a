"""Names that settings, files and parts of a task had before: read where runs have them, else told in errors."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest
from samples import make_run, written_page

import advsearch
from advsearch.cli.flags import add_settings, config_from
from advsearch.config import CONFIGS
from advsearch.errors import InputError
from advsearch.runs.summary import FORMERLY, read_configuration, write_configuration
from advsearch.tasks import Task

RENAMED = [
    (command, old, new)
    for command, config in CONFIGS.items()
    for old, new in config.formerly.items()
    if new not in config.without
]


@pytest.mark.parametrize(("command", "old", "new"), RENAMED)
def test_settings_are_read_by_their_former_names_from_files_and_flags(
    command: str, old: str, new: str, tmp_path: Path
) -> None:
    config = CONFIGS[command]
    needed = {"object": "mug"} if "object" in config.model_fields else {}
    expected = config(**{new: "mug-texture-001"}, **needed)
    lines = [f"{name}: {value}\n" for name, value in {old: "mug-texture-001", **needed}.items()]
    (tmp_path / "run.yaml").write_text("".join(lines), "utf-8")
    assert config.from_yaml(tmp_path / "run.yaml") == expected
    parser = argparse.ArgumentParser()
    add_settings(parser, config)
    typed = parser.parse_args([f"--{old.replace('_', '-')}", "mug-texture-001"])
    assert config_from(typed, config, **needed) == expected
    assert f"--{old.replace('_', '-')} " not in parser.format_help()
    with pytest.raises(TypeError, match=f"unexpected keyword argument '{old}'; did you mean `{new}`"):
        getattr(advsearch, command)(**{old: "mug-texture-001"})


def test_there_are_settings_with_former_names() -> None:
    assert {command for command, *_ in RENAMED} == {"sweep", "replay"}


def test_the_configuration_of_an_older_run_is_read(tmp_path: Path) -> None:
    point = np.array([0.25, 0.5], np.float32)
    path = write_configuration(tmp_path, point)
    path.rename(path.with_name(FORMERLY))
    assert read_configuration(tmp_path).tolist() == point.tolist()
    write_configuration(tmp_path, 1.0 - point)
    assert read_configuration(tmp_path).tolist() == (1.0 - point).tolist()


def test_the_page_of_an_older_run_shows_its_marked_pictures(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", rows=False)
    for name in ("clean", "adversarial", "verification-00"):
        (run / "images" / f"{name}-answer.png").write_bytes((run / "images" / f"{name}.png").read_bytes())
    page = written_page(run).read_text()
    assert "What it predicts" in page and "trial 00" in page and "trial 01" not in page


def test_a_task_with_parts_by_their_former_names_is_told_those_of_now() -> None:
    with pytest.raises(InputError, match="task Faded: `answers` is called `predictions` now; rename it"):
        type("Faded", (Task,), {"answers": lambda self, output, count=1: []})
