"""The page of a sweep, and the folder that any server can serve."""

from __future__ import annotations

import json
import re
from importlib import import_module
from pathlib import Path

import pytest

from advsearch.errors import InputError
from advsearch.questions.sweep.page import write_bundle
from stored_sweeps import make_sweep


def test_the_page_needs_nothing_else(tmp_path: Path) -> None:
    page = (make_sweep(tmp_path / "run", keep="all") / "report.html").read_text()
    assert not re.search(r"""(src|href)=["'](?!data:)""", page), "something is loaded from elsewhere"
    assert "connect-src" not in page
    assert page.count("data:image/jpeg") == 24


sweep_page = import_module("advsearch.questions.sweep.page")  # the room has a function of this name


def test_texts_of_a_run_are_no_markup(tmp_path: Path) -> None:
    page = (
        make_sweep(tmp_path / "</script><img onerror=1>", label="<script>alert(1)</script>") / "report.html"
    ).read_text()
    assert "alert(1)" not in re.sub(r'<script type="application/octet-stream".*?</script>', "", page)
    assert "<img onerror" not in page
    assert page.count("</script>") == 3  # what runs, what the explorer reads, and its own


@pytest.mark.parametrize("many", [False, True])
def test_the_folder_has_page_rows_and_pictures(many: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if many:
        monkeypatch.setattr(sweep_page, "MAX_EMBEDDED_ROWS", 0)
    first, second = make_sweep(tmp_path / "a", keep="wrong"), make_sweep(tmp_path / "b")
    index = write_bundle([first, second], tmp_path / "site")
    runs = json.loads(re.findall(r'id="runs">(.*?)</script>', index.read_text())[0])
    assert [one["name"] for one in runs] == ["a", "b"]
    for one in runs:
        assert (index.parent / one["rows"]).is_file() if many else one["embedded"]
    kept = runs[0]["pictures"]
    assert len(kept["kept"]) == 6
    for number in kept["kept"]:
        assert (index.parent / kept["folder"] / "0000" / f"{number}.{kept['suffix']}").is_file()
    assert "pictures" not in runs[1]


def test_a_folder_that_is_not_empty_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="not empty"):
        write_bundle([make_sweep(tmp_path / "a")], tmp_path)
