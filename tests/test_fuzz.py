"""The quick part of the fuzz of hostile files (`make fuzz` runs all), and that the fuzz sees what it looks for."""

from pathlib import Path

import pytest

from advsearch.cli.main import main
from fuzz import cases, run

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
