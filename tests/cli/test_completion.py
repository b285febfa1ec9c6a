"""`advsearch completion`: what Tab offers in bash, and that zsh reads its script."""

from __future__ import annotations

import shutil
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


@pytest.mark.skipif(shutil.which("zsh") is None, reason="there is no zsh here")
def test_zsh_reads_its_script(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert subprocess.run(["zsh", "-n", str(script("zsh", tmp_path, capsys))], check=False).returncode == 0


TYPED = r"""
zmodload zsh/zpty
zpty -b shell zsh -f -i
zpty -w shell "fpath=($1 \$fpath); autoload -Uz compinit; compinit -u -D; echo rea''dy"
typed() { # TEXT SHOWN: types a text, and waits until the line shows another
  local seen= part
  [[ -z $1 ]] || zpty -w -n shell $1
  for try in {1..100}; do
    while zpty -r -t shell part; do seen+=$part; done
    [[ $seen == *$2* ]] && { print -r -- $2; return; }
    sleep 0.1
  done
  print -r -- "not $2"
}
typed '' ready
typed $'advsearch att\t' attack
typed $'--contr\t' --control
typed $'tex\t' texture
zpty -d shell
"""


@pytest.mark.medium
@pytest.mark.skipif(shutil.which("zsh") is None, reason="there is no zsh here")
def test_tab_finishes_commands_flags_and_names_in_zsh(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script("zsh", tmp_path, capsys).rename(tmp_path / "_advsearch")
    line = ["zsh", "-f", "-c", TYPED, "zsh", str(tmp_path)]
    done = subprocess.run(line, capture_output=True, text=True, check=True, cwd=tmp_path, timeout=600)
    assert done.stdout.split() == ["ready", "attack", "--control", "texture"]
