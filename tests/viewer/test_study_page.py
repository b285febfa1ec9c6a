"""The pages of studies and of measurements: what is drawn, what the tables say, and where they lead."""

import re
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

from advsearch.cli.main import main
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results import Result, StudyResult
from advsearch.viewer.pages import write_page
from samples import ACCURACY, AVERAGE, CURVE, curve, make_run
from stored_sweeps import serving

ACCURACIES = ((0.01, 7), (0.03, 4), (0.1, 1))


def make_study(path: Path, result: Result) -> Path:
    """Make the run of a study, with a page for each of its parts but the last."""
    with RunDirectory.create_for(AttackConfig(object="mug", run=str(path))) as run:
        run.write_summary(result)
    for name in result.parts if isinstance(result, StudyResult) else ():
        make_run(path / "parts" / name, pictures=False)
        (path / "parts" / name / "report.html").write_text(f"the attack {name}")
    write_page(path, result)
    return path


def a_curve() -> Result:
    """Eight objects at three epsilons."""
    points = [
        {"epsilon": epsilon, "objects": 8, "robust": robust, "found": 8 - robust, "already_wrong": 0,
         "accuracy": robust / 8, "interval": [max(0, robust / 8 - 0.3), min(1, robust / 8 + 0.2)]}
        for epsilon, robust in ACCURACIES
    ]  # fmt: skip
    rows = [{**CURVE["table"][0], "run": "runs/mug/parts/00-mug"}]
    return curve(curve=points, table=rows, parts=["00-mug", "01-bowl"], objects=["mug", "bowl"])


def two_objects() -> Result:
    """Two objects, with the average of each."""
    average = {**AVERAGE, **ACCURACY}
    rows = [
        {**CURVE["table"][0], "object": name, "run": f"runs/x/parts/{name}", "average": average}
        for name in ("mug", "bowl")
    ]
    return curve(table=rows, parts=["mug", "bowl"])


def got(address: str) -> str:
    """What a server answers."""
    with urlopen(address, timeout=600) as answer:
        return str(answer.read().decode())


def text_of(page: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page).replace("&nbsp;", " "))


def test_a_curve_is_drawn_with_its_intervals_and_leads_to_its_attacks(tmp_path: Path) -> None:
    page = (make_study(tmp_path / "study", a_curve()) / "report.html").read_text()
    text = text_of(page)
    assert "Still recognised: 7 of 8 at epsilon 0.01 and 1 of 8 at epsilon 0.1." in text
    assert "0.03 4/8 50 % 20-70 % 0" in text
    chart = page[page.index('class="chart wide"') : page.index('class="chart narrow"')]
    assert "7 of 8 at 0.01; 4 of 8 at 0.03; 1 of 8 at 0.1" in chart
    assert chart.count("<use") >= len(ACCURACIES)  # a marker for each, which points at a shape
    for name in re.findall(r'href="#([^"]+)"', page):
        assert page.count(f'id="{name}"') == 1
    links = re.findall(r'<a href="([^"#]+)"', page)
    assert links == ["parts/00-mug/report.html", "parts/00-mug/report.html", "parts/01-bowl/report.html"]
    assert all((tmp_path / "study" / link).is_file() for link in links)


@pytest.mark.medium
def test_the_dashboard_and_a_bundle_have_the_pages_of_the_attacks(tmp_path: Path) -> None:
    run = make_study(tmp_path / "study", two_objects())
    with serving(run) as server:
        assert "parts/mug/report.html" in got(f"{server.address}runs/study/")
        assert got(f"{server.address}runs/study/parts/mug/report.html").endswith("the attack mug")
        (run / "parts" / "bowl" / "report.html").unlink()
        for path in ("bowl", "none", "..", "%2e%2e", "..%2f..%2fstudy"):
            with pytest.raises(HTTPError, match="404"):
                got(f"{server.address}runs/study/parts/{path}/report.html")
    assert main(["view", str(run), "--bundle", str(tmp_path / "site")]) == 0
    page = (tmp_path / "site" / "parts" / "mug" / "report.html").read_text()
    assert "the attack mug" not in page  # which anybody may have written; it is made anew
    assert "<h1>" in page
    assert "parts/mug/report.html" in (tmp_path / "site" / "index.html").read_text()
    assert not (tmp_path / "site" / "parts" / "bowl").exists()
