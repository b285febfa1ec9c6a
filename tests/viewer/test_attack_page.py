"""The report page: filled, escaped, self-contained; and the words that it shares with the final table."""

import re
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from advsearch.questions.attack import wording
from advsearch.report.figures import draw_searches
from advsearch.report.views import NARROW_WIDTH, WIDE_WIDTH, Html, join_html, make_chart_svg, make_element
from advsearch.report.wording import percent
from advsearch.viewer.document import read_asset
from samples import ATTACK, EASIER, FORMATION, TARGET, attack, keep_object, make_run, rated, written_page

VOID = {"meta", "img", "br", "hr", "link"}


class Page(HTMLParser):
    """The tags, texts and attributes of a page; fails where tags do not nest."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("style", "script"):
            self.words.append(data)

    @property
    def text(self) -> str:
        """All that a reader sees."""
        return " ".join(" ".join(self.words).replace("\u00a0", " ").split())

    def all(self, tag: str) -> list[dict[str, str | None]]:
        """Return the attributes of each such tag."""
        return [attributes for name, attributes in self.tags if name == tag]


def page_of(run: Path) -> Page:
    """Return the parsed report of a run."""
    return Page(written_page(run).read_text(encoding="utf-8"))


def test_the_page_says_it_all(tmp_path: Path) -> None:
    page = page_of(make_run(tmp_path / "run", attack(warnings=["A texture is missing."])))
    for text in (
        "A texture is missing.",
        "adversarial wrong in 20 of 20 83-100 % vase 91 %",
        "random search wrong in 1 of 20",
    ):
        assert text in page.text, text
    text = page.text
    for empty in ("texture: {}", "set: {}", "ask: {}", "estimator: {}", "over: {}", "metrics: {}"):
        text = text.replace(empty, "")
    assert not re.search(r"None|nan|\{|\}|\$", text)


def test_the_page_needs_nothing_from_elsewhere(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    keep_object(run)
    text = written_page(run).read_text()
    page, code = Page(text), "\n".join(map(read_asset, ("make.js", "attack.js", "object.js")))
    assert code in text
    assert not re.search(r"\b(fetch|import|XMLHttpRequest|WebSocket|https?:)", code)
    assert "//" not in re.sub(r'(base64,|id="object-file">")[A-Za-z0-9+/=]+', "", text.replace(code, ""))
    assert "url(" not in text and "@import" not in text
    assert {tag for tag, _ in page.tags}.isdisjoint({"iframe", "object", "a", "form"})
    assert [script.get("type") for script in page.all("script")] == ["application/json", "application/json", None]
    assert page.all("link") == [{"rel": "icon", "href": "data:,"}]
    assert len(page.all("img")) == 7
    assert all(str(image["src"]).startswith("data:image/") for image in page.all("img"))


def test_names_cannot_become_markup(tmp_path: Path) -> None:
    evil = "\"><script>alert('x')</script>&lt;"
    answer = {"label": evil, "index": 3, "probability": 0.5}
    summary = attack(
        object=evil, model=evil, environment=evil, controls=[evil], policy=evil, objective=evil, norm=evil,
        warnings=[evil], adversarial=answer, run=evil, command_line=None, python_only=[evil],
        clean={**ATTACK["clean"], **answer},
        verified=rated(labels={evil: 20}), baseline={**ATTACK["baseline"], "policy": evil},
        image_formation={**FORMATION, "filter": evil}, renders={evil: 1}, seconds={evil: 1.0, "total": 2.0},
    )  # fmt: skip
    make_run(tmp_path / "run", summary)
    page = page_of(tmp_path / "run")
    assert [script.get("type") for script in page.all("script")] == ["application/json", None]
    assert page.text.lower().count("alert('x')") > 15
    known = {"charset", "http-equiv", "content", "name", "lang", "class", "src", "alt", "scope", "role", "style"}
    known |= {"rel", "href", "id", "hidden", "data-picture", "title", "type", "tabindex"}
    for tag, attributes in page.tags:
        found = {name for name in attributes if not name.startswith("aria-")}
        assert tag in ("svg", "g", "path", "text") or found <= known


@pytest.mark.parametrize("ending", ["interrupted", "already wrong"])
def test_a_run_that_has_little_still_has_a_page(tmp_path: Path, ending: str) -> None:
    clean = {**ATTACK["clean"], "control": None}
    summary = attack(ending=ending, steps=3, clean=clean, adversarial=None, verified=None, baseline=None)
    page = page_of(make_run(tmp_path / "run", summary, pictures=False, rows=False))
    assert wording.attack_verdict(summary) in page.text
    assert not page.all("img") and "Verified rates" not in page.text


def test_text_is_escaped_and_markup_is_not() -> None:
    assert make_element("p", "<b>", Html("<i></i>"), None, class_='"') == '<p class="&quot;">&lt;b&gt;<i></i></p>'
    assert make_element("img", src="&") == '<img src="&amp;">'
    assert join_html("<", make_element("br")) == "&lt;<br>"


def searches(objectives: dict[str, list[float | None]], zero: str = "", width: int = WIDE_WIDTH) -> Html:
    return make_chart_svg(partial(draw_searches, objectives, "margin", zero_means=zero), "the search", width)


@pytest.mark.medium
@pytest.mark.parametrize("width", [WIDE_WIDTH, NARROW_WIDTH])
@pytest.mark.parametrize(
    "values", [[1.0], [2.0, 2.0, 2.0], [None, 1.0, None], [1e-12, 2e-12], [-1e9, 1e9], [float(i) for i in range(5000)]]
)
def test_a_chart_of_any_values_is_drawn_inside_its_frame(values: list[float | None], width: int) -> None:
    page = Page(searches({"a": values, "random": values}, "wrong", width))
    lines = [path for path in page.all("path") if re.search(r"stroke-width: 2\b", str(path["style"]))]
    assert [re.findall(r"var\(--(\w+)\)", str(line["style"])) for line in lines] == [["search"], ["baseline"]] * 2, (
        "the legend draws them again"
    )
    assert lines[0]["d"] == lines[1]["d"]
    points = [tuple(map(float, pair)) for pair in re.findall(r"[ML] (\S+) (\S+)", str(lines[0]["d"]))]
    finite = values[next(step for step, value in enumerate(values) if value is not None) :]
    assert len(points) == min(len(finite), 400)
    assert all(0 <= x <= width and 0 <= y <= 300 for x, y in points)
    assert [x for x, _ in points] == sorted(x for x, _ in points)
    assert "wrong" in page.text


ALL = "20 of 20 fresh renders (95 % interval 83-100 %)."


@pytest.mark.parametrize(
    ("fields", "claim", "rate"),
    [
        ({}, "calls this mug a vase", ALL),
        ({"verified": rated(19, 0.751, 0.9987)}, "something else (a vase)", "19 of 20 fresh renders"),
        ({"ending": "budget spent", "verified": rated(0, 0.0, 0.168)}, "No change", "wrong in 0 of 20 fresh renders"),
        ({"ending": "not verified", "verified": rated(3, 0.032, 0.379)}, "not confirmed", "3.2-38 %"),
        (
            {"ending": "already wrong", "clean": {**ATTACK["clean"], "label": "vase"}}, "already",
            "nothing counts as found",
        ),
        ({**TARGET, "target": ["vase", "iron"], "verified": rated(labels={"iron": 12, "vase": 8})}, "an iron", ALL),
        ({**EASIER, "ending": "stalled", "verified": rated(3, 0.032, 0.379)}, "No change", "3 of 20 fresh renders"),
    ],
)  # fmt: skip
def test_the_verdict_says_what_is_known_and_no_more(fields: dict[str, Any], claim: str, rate: str) -> None:
    verdict = wording.attack_verdict(attack(**fields))
    assert claim in verdict and rate in verdict


@pytest.mark.parametrize(
    ("share", "text"),
    [(1.0, "100 %"), (0.9987, "99.9 %"), (0.999999999, "over 99.9999 %"), (0.8316, "83 %"), (None, "unknown")],
)
def test_only_certainty_is_called_100_percent(share: float | None, text: str) -> None:
    assert percent(share) == text
