"""The quick part of the fuzz of hostile files (`make fuzz` runs all), and that the fuzz sees what it looks for."""

from __future__ import annotations

from pathlib import Path

import pytest

from advsearch.cli.main import main
from fuzz import cases, run
from fuzz.case import Case

SEED, NUMBERS = 7, len(cases.MAKERS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for the files of all cases."""
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.medium
def test_hostile_files_are_loaded_or_refused(folder: Path) -> None:
    outcomes = list(run.run([(number, cases.make(SEED, number)) for number in range(NUMBERS)], folder))
    assert [outcome for outcome in outcomes if outcome.faults] == []
    assert {outcome.ending for outcome in outcomes} == {"loaded", "refused"}


@pytest.mark.parametrize("name", ["thing.obj", "room.hdr"])
def test_a_device_is_one_sentence_on_the_command_line(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / name).symlink_to("/dev/zero")
    given = {"object": "mug", "environment": "studio"} | {"object" if name == "thing.obj" else "environment": name}
    monkeypatch.chdir(tmp_path)
    assert main(["render", "--object", given["object"], "--environment", given["environment"], "--out", "a.png"]) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and "Traceback" not in printed.err
    assert f"{name}: expected an" in printed.err.splitlines()[-1] and "got a device" in printed.err.splitlines()[-1]


@pytest.mark.medium
def test_the_fuzz_sees_what_must_not_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = {
        "nothing": "",
        "raise": "an error that is not for users",
        "print": "prints 'a warning",
        "run": "subprocess.Popen",
        "read outside": "reads ",
        "write outside": "a file outside the run folder changed",
        "take memory": "takes more than 1 GiB",
        "crash": "the process died with status",
        "spin": "takes more than 2 CPU seconds",
    }
    made = [(k, Case(deed, "misbehave", "deed", {"deed": deed.encode()})) for k, deed in enumerate(expected)]
    for outcome in run.run(made, tmp_path):
        faults = "; ".join(outcome.faults)
        assert expected[outcome.what] in faults, outcome
        assert faults or outcome.what == "nothing"
        if outcome.what == "crash":  # all that is left is to spin; to take memory takes time too
            monkeypatch.setattr(run, "CPU_SECONDS", 2.0)
