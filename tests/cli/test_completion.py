"""`advsearch completion`: what Tab offers in bash."""

import subprocess
from pathlib import Path

import pytest

from advsearch.cli.main import main

OFFERED = r"""
source "$0"
COMP_WORDS=("$@") COMP_CWORD=$(($# - 1))
_shtab_advsearch advsearch "${COMP_WORDS[COMP_CWORD]}"
printf '%s\n' "${COMPREPLY[@]}"
"""


def script(shell: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    assert main(["completion", shell]) == 0
    (folder / shell).write_text(capsys.readouterr().out)
    return folder / shell


def test_tab_finishes_commands_flags_names_and_files_in_bash(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bash = script("bash", tmp_path, capsys)
    (tmp_path / "mugs.glb").touch()

    def offered(*typed: str) -> list[str]:
        line = ["bash", "-c", OFFERED, str(bash), "advsearch", *typed]
        return subprocess.run(line, capture_output=True, text=True, check=True, cwd=tmp_path).stdout.split()

    assert offered("att") == ["attack"]
    assert offered("attack", "--contr") == ["--control"]
    assert offered("attack", "--control", "tex") == ["texture"]
    assert offered("sweep", "--object", "mug") == ["mug", "mugs.glb"]
    assert offered("list", "pol") == ["policies"]
    assert offered("attack", "--labels", "mu") == ["mugs.glb"]
