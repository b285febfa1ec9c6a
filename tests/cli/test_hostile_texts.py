"""YAML, label files, names and the terminal: limits, types, and characters that steer a terminal."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from advsearch.cli.main import main
from advsearch.errors import FileFormatError
from advsearch.models import read_labels
from advsearch.progress import escape_text
from advsearch.settings import parse_assignment, read_yaml

ESCAPES = "\x1b]0;title\x07\x9b31m\x7f\u202e\r"


def aliases(levels: int, merge: bool) -> str:
    """Text that is small in the file and has 9 to the power of `levels` values in memory."""
    lines = ["a: &a {k: 1}" if merge else "a: &a [x, x]"]
    for level in range(levels):
        name, inner = chr(98 + level), ", ".join([f"*{chr(97 + level)}"] * 9)
        lines.append(f"{name}: &{name}\n  <<: [{inner}]" if merge else f"{name}: &{name} [{inner}]")
    return "\n".join(lines)


YAML = {
    "many hexadecimal digits": "seed: 0x" + "f" * 6000,
    "a binary number without digits": "seed: 0b_",
    "a date that does not exist": "seed: 2026-02-30",
    "a number by tag": "seed: !!int abc",
    "a Python object": "seed: !!python/object/apply:os.mkdir [executed]",
    "nested lists": "seed: " + "[" * 100_000,
    "aliases": aliases(12, merge=False),
    "an alias of itself": "seed: &a [*a]",
    "a long list": "seed: [" + "x," * 200_000 + "x]",
    "a zero byte": "seed: \0",
    "a list as key": "controls: {? [a] : 1}",
    "a long name": "x" * 5000 + ": 1",
    "a long object": "object: " + "x" * 5000,
    "a base with a zero byte": 'base: "a\\0b"',
    "a base that is a device": "base: /dev/zero",
    "a name that steers the terminal": '"\\e[2J": 1',
    "a schema of another type": "schema: {a: 1}",
}


@pytest.mark.medium
@pytest.mark.parametrize("case", YAML)
def test_yaml_files_are_refused_in_one_short_sentence(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run.yaml").write_text(YAML[case])
    began = time.process_time()
    assert main(["run", "run.yaml", "--run", "out", "--quiet"]) == 2
    assert time.process_time() - began < 10
    captured = capsys.readouterr()
    assert captured.err.startswith("advsearch: error: ") and captured.err.count("\n") == 1
    assert len(captured.err) < 900 and captured.err.strip().isprintable() and captured.out == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.yaml"]


def test_a_base_in_a_pipe_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "run.yaml").write_text("base: pipe.yaml\n")
    with pytest.raises(FileFormatError, match=r"pipe\.yaml"):
        read_yaml(tmp_path / "run.yaml")


@pytest.mark.medium
def test_what_is_no_yaml_on_the_command_line_is_text() -> None:
    for value in ("!!int ''", "1" * 6000, "[" * 5000):
        assert parse_assignment(f"run={value}", "--set") == ("run", value)


@pytest.mark.parametrize(
    "content, message",
    [
        (b"[" * 100_000, "nested deeper than 100"),
        (b"[" + b"1" * 6000 + b"]", "a whole number of 6000 digits"),
        (json.dumps(["x" * 5000]).encode(), "at most 1000 characters for class 0, got 5,000"),
        (b'["' + b"x" * (17 << 20) + b'"]', r"at most 16,777,216 bytes, got .*ADVSEARCH_LIMITS"),
        (b"[[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20]]", "for class 0, got"),
    ],
)
def test_label_files_have_limits(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "labels.json"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_labels(path)
    assert len(str(caught.value)) < 300 + len(str(path))


def test_what_steers_a_terminal_becomes_readable() -> None:
    assert escape_text(f"a{ESCAPES}b") == r"a\x1b]0;title\x07\x9b31m\x7f\u202e\x0db"
    assert escape_text("mug \u2014 coffee\u00a0cup\n\t\u00e9") == "mug \u2014 coffee\u00a0cup\n\t\u00e9"
    assert escape_text("\u00e9\udc80", "ascii") == r"\xe9\udc80"


@pytest.mark.parametrize(
    "arguments",
    [
        ["attack", "--object", f"mug{ESCAPES}", "--control", "pose"],
        ["attack", "--object", "mug", "--control", "pose", f"--x{ESCAPES}"], ["show", f"mug{ESCAPES}"],
        ["attack", "--object", "mug", "--labels", "x" * 5000, "--control", "pose"],
        ["attack", "--object", "mug", "--control", "pose", "--seed", "1" * 6000], ["show", "x" * 5000],
        ["region", "--around", "x" * 5000], ["attack", "--object", "a\0b", "--control", "pose"],
        ["attack", "--object", "mug", "--model", "a\0b.pt2", "--control", "pose"],
    ],
)  # fmt: skip
def test_names_are_shown_short_and_without_escapes(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    told = capsys.readouterr().err.splitlines()
    *_, error = told
    assert all(": loading " in line for line in told[:-1])  # whoever waits long is told for what
    assert error.isprintable() and len(error) < 1500


def test_json_for_a_terminal_is_json_still(capsys: pytest.CaptureFixture[str]) -> None:
    from advsearch.cli import output
    from advsearch.cli.output import escape_output

    with escape_output():
        output.print_json({"name": ESCAPES, "\u00e9": "\U000e0001"})
    text = capsys.readouterr().out
    assert json.loads(text) == {"name": ESCAPES, "\u00e9": "\U000e0001"} and text.replace("\n", "").isprintable()


def shell(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run `advsearch ...` in bash."""
    line = command.replace("advsearch", f"{sys.executable} -m advsearch")
    return subprocess.run(["bash", "-c", line], cwd=folder, capture_output=True, text=True, timeout=600)


@pytest.mark.medium
@pytest.mark.parametrize(
    "command, status, message",
    [
        ("advsearch runs > /dev/full", 2, "cannot write to standard output: No space left on device\n"),
        ("advsearch --help | head -1", 0, ""),
        ("advsearch runs >&-", 0, ""),
        ("advsearch nope 2> /dev/full", 2, ""),
    ],
)
def test_an_output_that_cannot_be_written_is_no_bug(command: str, status: int, message: str, tmp_path: Path) -> None:
    result = shell(command, tmp_path)
    assert result.returncode == status and result.stderr.endswith(message)
    assert "Traceback" not in result.stderr and "Exception ignored" not in result.stderr


@pytest.mark.medium
@pytest.mark.parametrize("delay", [0.0, 0.05])
def test_two_quick_interrupts_leave_no_traceback(delay: float, tmp_path: Path) -> None:
    """While PyTorch is being imported, which makes other errors of an interrupt."""
    words = [sys.executable, "-m", "advsearch", "attack", "--object", "mug", "--control", "pose", "--resolution", "16"]
    process = subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    time.sleep(1.5)
    for _ in range(2):
        process.send_signal(2)
        time.sleep(delay)
    error = process.communicate(timeout=600)[1]
    assert process.returncode in (130, -2)  # the second: before our own code began
    assert "Traceback" not in error and "Exception ignored" not in error


STRUCK = """
import os, signal, sys
sys.argv = ["advsearch", "nope"]
from advsearch import __main__
from advsearch.cli import main
before = {where}
def struck(*values):
    if signal.SIG_DFL not in values and main.INTERRUPTS not in values:  # these two are where Ctrl-C begins to count
        os.kill(os.getpid(), signal.SIGINT)
    return before(*values)
{where} = struck
sys.exit(__main__.start())
"""


@pytest.mark.medium
@pytest.mark.parametrize(
    "where, status",
    [
        ("main._run_to_status", 130),
        ("main._run_and_report_errors", 130),
        ("main.signal.signal", 2),
        ("main.end_output", 2),
    ],
)
def test_an_interrupt_at_either_end_leaves_no_traceback(where: str, status: int, tmp_path: Path) -> None:
    """Before a command begins, inside it, and when it is over: then its own status stands."""
    words = [sys.executable, "-c", STRUCK.format(where=where)]
    result = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert result.returncode == status and "Traceback" not in result.stderr
