"""The page of a sweep, and the folder that any server can serve."""

import json
import re
from importlib import import_module
from pathlib import Path

import pytest

from advsearch.questions.sweep.page import write_bundle
from stored_sweeps import make_sweep

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
