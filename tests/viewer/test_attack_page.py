"""The report page: filled, escaped, self-contained; and the words that it shares with the final table."""

from __future__ import annotations

import re
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from advsearch.questions.attack import wording
from advsearch.report.figures import draw_searches
from advsearch.report.views import NARROW_WIDTH, WIDE_WIDTH, Html, join_html, make_chart_svg, make_element
from advsearch.report.wording import percent
from advsearch.runs.files import read_png
from advsearch.viewer.document import read_asset
from advsearch.viewer.pages import MAX_SCALED_SIZE, MAX_UNSCALED_BYTES
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


# ---- the page ----


def test_the_page_says_it_all(tmp_path: Path) -> None:
    page = page_of(make_run(tmp_path / "run", attack(warnings=["A texture is missing."])))
    for text in (
        "The model calls this mug a vase in 20 of 20 fresh renders (95 % interval 83-100 %).",
        "A texture is missing.",
        "Clean : mug, 98 %",
        "Adversarial : vase, 91 %",
        "5 times magnified, grey where nothing changed",
        "trial 00",
        "clean right in 20 of 20 83-100 % mug 98 %",
        "adversarial wrong in 20 of 20 83-100 % vase 91 %",
        "random search wrong in 1 of 20 0.1-25 % 40 pictures",
        "64 samples per pixel",
        "margin loss [logits]",
        "pgd, 40 steps",
        "texture within 0.1 (linf)",
        "40 of the search, 40 gradients, 21 of the verification",
        "14.6 s (setup 3.1 s, search 9.0 s, verification 2.2 s)",
        "128 x 128 pixels, box filter, denoised (oidn), exposure 0 stops",
        f"advsearch run {tmp_path}/run/run.yaml",
        "texture_resolution: null",
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


def test_the_page_is_accessible(tmp_path: Path) -> None:
    page = page_of(make_run(tmp_path / "run"))
    assert page.all("html")[0]["lang"] == "en"
    assert len(page.all("h1")) == len(page.all("main")) == len(page.all("title")[:1]) == 1
    assert all(image.get("alt") for image in page.all("img"))
    assert all(head.get("scope") in ("row", "col") for head in page.all("th") if head.get("class") != "hide-small")
    charts = page.all("svg")
    assert [svg["class"] for svg in charts] == ["chart wide", "chart narrow"]  # the style sheet shows one of them
    for svg in charts:
        assert svg["role"] == "img" and "pgd: from -2 to 1.9" in str(svg["aria-label"])


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


@pytest.mark.medium
def test_a_large_picture_is_embedded_smaller(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    large = run / "artifacts" / "texture.png"
    noise = np.random.default_rng(0).random((700, 700, 3))
    from advsearch.runs.files import write_png

    write_png(large, noise)
    assert large.stat().st_size > MAX_UNSCALED_BYTES
    source = next(str(image["src"]) for image in page_of(run).all("img") if "found" in str(image["alt"]))
    import base64

    (tmp_path / "small.png").write_bytes(base64.b64decode(source.partition(",")[2]))
    assert read_png(tmp_path / "small.png").shape == (MAX_SCALED_SIZE, MAX_SCALED_SIZE, 3)


# ---- charts and markup ----


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


# ---- words ----


ALL = "20 of 20 fresh renders (95 % interval 83-100 %)."


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({}, f"The model calls this mug a vase in {ALL}"),
        (
            {"verified": rated(19, 0.751, 0.9987), "object": "data/wine_glass.obj"},
            "The model takes this wine glass for something else (a vase) in 19 of 20 fresh renders"
            " (95 % interval 75-99.9 %).",
        ),
        (
            {"ending": "budget spent", "verified": rated(0, 0.0, 0.168)},
            "No change of texture within 0.1 (linf) was found that makes the model miss this mug: it is wrong in 0 of"
            " 20 fresh renders (95 % interval 0-17 %). The budget is spent.",
        ),
        (
            {"ending": "not verified", "verified": rated(3, 0.032, 0.379)},
            "The search claims a wrong prediction that is not confirmed: the model is wrong about this mug in 3 of 20 "
            "fresh renders (95 % interval 3.2-38 %).",
        ),
        (
            {"ending": "already wrong", "clean": {**ATTACK["clean"], "label": "vase"}},
            "The model already calls this mug a vase: nothing was changed and nothing counts as found.",
        ),
        (
            {**TARGET, "target": ["vase", "iron"], "verified": rated(labels={"iron": 12, "vase": 8})},
            f"The model takes this mug for one of the targets, most often calling it an iron, in {ALL}",
        ),
        (
            {**EASIER, "ending": "stalled", "verified": rated(3, 0.032, 0.379)},
            "No change of texture within 0.1 (linf) was found that makes this mug easier to recognise: the model"
            " recognises this mug, more surely than in the clean scene, in 3 of 20 fresh renders (95 % interval"
            " 3.2-38 %). The policy had nothing more to propose.",
        ),
    ],
)
def test_the_verdict_says_what_is_known_and_no_more(fields: dict[str, Any], sentence: str) -> None:
    assert wording.attack_verdict(attack(**fields)) == sentence


@pytest.mark.parametrize(
    ("share", "text"),
    [(1.0, "100 %"), (0.9987, "99.9 %"), (0.999999999, "over 99.9999 %"), (0.8316, "83 %"), (None, "unknown")],
)
def test_only_certainty_is_called_100_percent(share: float | None, text: str) -> None:
    assert percent(share) == text
