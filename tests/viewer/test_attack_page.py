"""The report page: filled, escaped, self-contained; and the words that it shares with the final table."""

from __future__ import annotations

import re
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from advsearch.attacks.objectives import OBJECTIVE_KINDS
from advsearch.errors import FileFormatError
from advsearch.questions.attack import wording
from advsearch.report.figures import draw_searches
from advsearch.report.views import NARROW_WIDTH, WIDE_WIDTH, Html, join_html, make_chart_svg, make_element
from advsearch.report.wording import format_interval, format_objective, format_seconds, percent
from advsearch.runs.directory import OBJECT_FILE
from advsearch.runs.files import read_png
from advsearch.statistics.intervals import clopper_pearson
from advsearch.viewer.document import read_asset
from advsearch.viewer.pages import MAX_OBJECT_BYTES, MAX_SCALED_SIZE, MAX_UNSCALED_BYTES, make_object_part, read_object
from samples import (
    ATTACK,
    AVERAGE,
    BRACKET,
    EASIER,
    FORMATION,
    SUMMARY,
    TARGET,
    attack,
    keep_object,
    make_run,
    rated,
    written_page,
)

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


ANY: dict[str, Any] = {"goal": "a wrong answer", "target": None, "over": []}


def test_the_page_says_what_was_asked_beside_the_worst_case(tmp_path: Path) -> None:
    summary = attack(**TARGET, over=["camera", "environment"], average=AVERAGE, smallest=BRACKET)
    page = page_of(make_run(tmp_path / "run", summary))
    for text in (
        "in 20 of 20 fresh renders (95 % interval 83-100 %), each with another camera and environment.",
        "adversarial target in 20 of 20 83-100 % vase 91 %",
        "random search target in 1 of 20 0.1-25 % 40 pictures",
        "average case right in 150 of 200 68-81 % 200 configurations",
        "Wanted the model should predict vase",
        "Over camera and environment, drawn anew for every picture",
        "Smallest 0.0123; no search found one at 0.0118",
    ):
        assert text in page.text, text
    assert "above: target" in [part.strip() for part in page.words]
    bars = [bar["style"] for bar in page.all("span") if bar.get("class") == "range"]
    assert len(bars) == 4 and bars[0] == "left: 83.2%; width: 16.8%"


def test_the_page_does_not_say_what_was_not_asked(tmp_path: Path) -> None:
    text = page_of(make_run(tmp_path / "run", attack(**ANY))).text
    assert not re.search(r"Wanted|Over |Smallest|average case", text)


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


def test_a_phone_gets_a_chart_that_fits_with_letters_that_can_be_read(tmp_path: Path) -> None:
    text = written_page(make_run(tmp_path / "run")).read_text(encoding="utf-8")
    narrow = next(svg for svg in Page(text).all("svg") if svg["class"] == "chart narrow")
    width = float(str(narrow["viewbox"]).split()[2])
    assert (
        width <= 390 - 2 * 20
    )  # what the page leaves of a phone: letters of 13 are drawn as such, and nothing scrolls
    assert "min-width" not in re.findall(r"svg\.chart \{[^}]*\}", read_asset("document.css"))[0]
    css = read_asset("document.css")
    phone = css.index("@media (max-width: 34rem)")
    assert css.index("svg.narrow { display: none; }") < phone < css.index("svg.narrow { display: block; }")


def test_numbers_have_the_digits_that_mean_something(tmp_path: Path) -> None:
    formation = {**FORMATION, "gain": 0.41234567890123456, "exposure": 1 / 3}
    verified = rated(margin=1.2345678901234567)
    page = page_of(
        make_run(tmp_path / "run", attack(image_formation=formation, epsilon=1 / 3, verified=verified), rows=False)
    )
    assert "gain 0.4123" in page.text and not re.findall(r"\d\.\d{7,}", page.text)


@pytest.mark.parametrize("name", [*OBJECTIVE_KINDS, "one of my own"])
def test_an_objective_has_its_unit(name: str) -> None:
    unit = OBJECTIVE_KINDS[name].unit.partition(" (")[0] if name in OBJECTIVE_KINDS else "none"
    shown = {"margin": "margin loss", "pixel_margin": "margin loss of the pixels"}.get(name, name)
    told = shown if unit in ("none", "that of the task") else f"{shown} [{unit}]"
    assert format_objective(name) == told


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


def test_without_a_summary_there_is_no_page(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="expected the summary of a run"):
        written_page(tmp_path)
    assert not list(tmp_path.iterdir())


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


def test_the_numbers_at_an_axis_are_whole() -> None:
    assert {"1.00", "1.25", "1.50"} <= set(Page(searches({"a": [1.0, 3.0]})).text.split())
    texts = Page(searches({"a": [5.0]})).text.split()
    assert texts[texts.index("evaluations", 3) - 2 :][:2] == ["1", "2"], "there is no evaluation 0.5"


@pytest.mark.parametrize("name", ["$x$", "<b>&", "\u6a21"])
def test_any_name_may_stand_in_a_chart(name: str) -> None:
    page = Page(make_chart_svg(partial(draw_searches, {name: [0.0, 1.0]}, name), name))
    assert page.text.count(name) >= 3 and not page.all("b")


# ---- words ----


ALL = "20 of 20 fresh renders (95 % interval 83-100 %)."


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({}, f"The model calls this mug a vase in {ALL}"),
        (
            {"verified": rated(labels={"iron": 12, "vase": 8})},
            f"The model is wrong about this mug, most often calling it an iron, in {ALL}",
        ),
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
            {"ending": "interrupted", "verified": None},
            "Interrupted after 40 steps. What was found so far is not verified: the model calls this mug a vase.",
        ),
        (
            {"ending": "interrupted", "verified": None, "adversarial": None, "steps": 0},
            "Interrupted after 0 steps; nothing is verified.",
        ),
        ({"ending": "interrupted", "steps": 1}, f"Interrupted; so far the model is wrong about this mug in {ALL}"),
        ({"ending": "stalled", "verified": None, "steps": 1}, "Stalled after 1 step; nothing is verified."),
        (TARGET, f"The model calls this mug a vase in {ALL}"),
        (
            {
                **TARGET,
                "target": ["vase", "iron"],
                "verified": rated(labels={"iron": 12, "vase": 8}),
            },
            f"The model takes this mug for one of the targets, most often calling it an iron, in {ALL}",
        ),
        (
            {**TARGET, "target": ["vase", "iron"], "ending": "budget spent", "verified": rated(2, 0.012, 0.317)},
            "No change of texture within 0.1 (linf) was found that makes the model call this mug a vase or an iron: the"
            " model calls this mug a vase or an iron in 2 of 20 fresh renders (95 % interval 1.2-32 %). The budget is"
            " spent.",
        ),
        (
            {**TARGET, "ending": "not verified", "verified": rated(3, 0.032, 0.379)},
            "The search claims a wrong prediction that is not confirmed: the model calls this mug a vase in 3 of 20 "
            "fresh renders (95 % interval 3.2-38 %).",
        ),
        (
            {**EASIER, "verified": rated(labels={"mug": 20})},
            f"The model recognises this mug, more surely than in the clean scene, in {ALL}",
        ),
        (
            {**EASIER, "ending": "stalled", "verified": rated(3, 0.032, 0.379)},
            "No change of texture within 0.1 (linf) was found that makes this mug easier to recognise: the model"
            " recognises this mug, more surely than in the clean scene, in 3 of 20 fresh renders (95 % interval"
            " 3.2-38 %). The policy had nothing more to propose.",
        ),
        (
            {"over": ["camera"]},
            "The model calls this mug a vase in 20 of 20 fresh renders (95 % interval 83-100 %), each with another"
            " camera.",
        ),
    ],
)
def test_the_verdict_says_what_is_known_and_no_more(fields: dict[str, Any], sentence: str) -> None:
    assert wording.attack_verdict(attack(**fields)) == sentence


@pytest.mark.parametrize("goal", [ANY, TARGET, EASIER], ids=["wrong", "target", "easier"])
def test_every_ending_has_a_verdict(goal: dict[str, Any]) -> None:
    from advsearch.attacks.verification import Ending

    said = [wording.attack_verdict(attack(ending=ending.value, **goal)) for ending in Ending]
    assert len(set(said)) == len(said)
    assert all("mug" in text for text in said)


@pytest.mark.parametrize(
    ("bracket", "text"),
    [
        ({}, "0.0123; no search found one at 0.0118"),
        ({"closed": False}, "0.0123; no search found one at 0.0118; the searches did not suffice to bring the two"
                            " together"),
        ({"not_found_at": None, "closed": False}, "0.0123; no search failed, so it may be smaller still"),
        ({"epsilon": None, "not_found_at": {"texture": 0.1}, "closed": False}, "none found up to 0.1"),
        (
            {"epsilon": {"texture": 0.02, "geometry": 0.004}, "not_found_at": {"texture": 0.0195, "geometry": 0.0039}},
            "texture 0.02, geometry 0.004; no search found one at texture 0.0195, geometry 0.0039",
        ),
    ],
)  # fmt: skip
def test_a_bracket_says_what_is_known_of_both_ends(bracket: dict[str, Any], text: str) -> None:
    assert wording.smallest_text(attack(smallest={**BRACKET, **bracket})) == text
    assert wording.smallest_text(SUMMARY) == ""


def test_several_controls_have_a_budget_each() -> None:
    several = attack(
        controls=["texture", "pose"], epsilon={"texture": 0.05, "pose": None}, norm={"texture": "l2", "pose": "box"}
    )
    assert wording.budget_text(several) == "texture within 0.05 (l2) and pose"
    assert wording.renders_text(attack(renders={"search": 8, "gradient": 0})) == "8 of the search"
    assert wording.renders_text(attack(renders={"search": 0})) == "none"
    assert (
        wording.changed_text(several) == "texture within 0.05 (l2: the root of the sum of all squared changes) and pose"
    )
    third = attack(
        controls=["texture", "patch"],
        epsilon={"texture": 1 / 3, "patch": 1.0},
        norm={"texture": "linf", "patch": "linf"},
    )
    meant = "texture within 0.3333 (linf: the largest change of any value) and patch within 1 (linf)"
    assert wording.changed_text(third) == meant
    assert wording.budget_text(attack(controls=["pose", "light"], epsilon=None)) == "pose and light"


def test_conditions_that_the_clean_scene_fails_are_said_not_to_count() -> None:
    clean = {**ATTACK["clean"], "control": {"correct": 188, "trials": 200, "rate": 0.94, "interval": [0.9, 0.97]}}
    said = "The clean scene itself fails 12 of its 200 trials."
    assert wording.make_remarks(attack(clean=clean, baseline=None, over=["camera"])) == [f"{said} They do not count."]
    assert wording.make_remarks(attack(clean=clean, baseline=None)) == [said]
    assert wording.make_remarks(attack(clean=clean, baseline=None, **EASIER)) == []


@pytest.mark.parametrize(
    ("successes", "remark"),
    [
        (20, ["Random search with as many renders does as well: 20 of 20. The policy adds nothing here."]),
        (19, []),
    ],
)
def test_a_random_search_that_does_as_well_is_said(successes: int, remark: list[str]) -> None:
    assert wording.make_remarks(attack(baseline={**ATTACK["baseline"], "verified": rated(successes)})) == remark


def test_a_better_random_search_and_a_failing_control_group_are_said() -> None:
    clean = {**ATTACK["clean"], "control": {"correct": 18, "trials": 20, "rate": 0.9, "interval": [0.7, 0.99]}}
    summary = attack(verified=rated(3), baseline={**ATTACK["baseline"], "verified": rated(5)}, clean=clean)
    assert wording.make_remarks(summary) == [
        "The clean scene itself fails 2 of its 20 trials.",
        "Random search with as many renders does better: 5 of 20.",
    ]


def test_of_a_path_each_trial_has_another_moment() -> None:
    said = {(): "", ("camera", "light"): ", each with another camera and light"}
    said |= {("path",): ", each at another moment of the path"}
    said |= {("path", "camera"): ", each with another camera and at another moment of the path"}
    assert {over: wording.condition_text(over) for over in said} == said


def test_the_ends_of_an_interval_have_the_digits_that_fit_and_are_not_clamped() -> None:
    assert format_interval(clopper_pearson(1, 120)) == "0.02-4.6 %"
    assert format_interval(clopper_pearson(119, 120)) == "95.4-99.98 %"
    assert format_interval(clopper_pearson(1, 10_000)) == "0.0003-0.06 %"
    assert format_interval(clopper_pearson(60, 120)) == "41-59 %"


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (1.0, "100 %"),
        (0.0, "0 %"),
        (0.9987, "99.9 %"),
        (0.99999, "99.999 %"),
        (0.999999999, "over 99.9999 %"),
        (0.046, "4.6 %"),
        (0.97, "97 %"),
        (0.8316, "83 %"),
        (0.001, "0.1 %"),
        (None, "unknown"),
    ],
)
def test_only_certainty_is_called_100_percent(share: float | None, text: str) -> None:
    assert percent(share) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.26, "0.3 s"), (99.4, "99.4 s"), (185, "3 min 5 s"), (7800, "2 h 10 min"), (None, "unknown")],
)
def test_times(seconds: float | None, text: str) -> None:
    assert format_seconds(seconds) == text


def test_where_random_search_won_it_is_said() -> None:
    own = rated(3, margin=-1.25)
    (said,) = [
        text for text in wording.make_remarks(attack(answer_from="random", policy_verified=own)) if "random" in text
    ]
    assert "worse configuration than the policy did (3 of 20 with a margin of -1.25)" in said


def test_a_damaged_object_is_left_out(tmp_path: Path) -> None:
    file = tmp_path / OBJECT_FILE
    assert read_object(tmp_path) == b""
    keep_object(tmp_path)
    good = file.read_bytes()
    assert read_object(tmp_path) == good
    assert "It has fewer faces here." in make_object_part(good).note
    for data in (b"", b"glTF", b"glTF" + bytes(40), b"GIF89a" * 9, good[:2000], good + bytes(MAX_OBJECT_BYTES)):
        file.write_bytes(data)
        assert read_object(tmp_path) == b""
    assert make_object_part(b"").is_empty


METHOD: dict[str, Any] = {
    "gradient_plan": {"renders_per_gradient": 2, "spp": 8, "groups": [
        {"control": "pose", "parameter": "yaw", "size": 1, "estimator": "secant", "valid": ["secant"], "step": 0.03,
         "step_reason": "an outline moves", "reason": "the quickest", "variance_x_seconds": {}, "step_in_unit": 5.4,
         "unit": "degrees"},
        {"control": "texture", "parameter": "texels", "size": 192, "estimator": "adjoint", "valid": ["adjoint"],
         "step": 0.05, "step_reason": "", "reason": "the only one", "variance_x_seconds": {}, "step_in_unit": None,
         "unit": ""}]},
    "transport": {"used": True, "error": {"levels": 0.8123, "logits": None}, "renewed": 1, "seconds": 2.0},
    "renders": {"search": 3, "products": 37},
    "gradients": {"count": 36, "cosine_with_the_one_before": 0.253, "zero": 2, "cut": 1, "shortened": 4, "rejected": 3},
    "claimed": {"objective": 4.5, "re_evaluated": 3.25, "success_rate": 1.0},
    "sample_count": {"spp": 64, "converged": False},
    "non_finite": {"objectives": 1, "gradient_elements": 7},
    "printability": {"clean": {"variation": 0.01, "off_print": 0.2}, "answer": {"variation": 0.03, "off_print": 0.1}},
    "configuration": {
        "pose.yaw": {"value": 90.0, "unit": "degrees", "clean": 0.0, "low": -90.0, "high": 90.0},
        "pose.roll": {"value": 9.0, "unit": "degrees", "clean": 0.0, "low": -90.0, "high": 90.0},
    },
}  # fmt: skip


def test_the_page_says_how_the_search_worked(tmp_path: Path) -> None:
    text = page_of(make_run(tmp_path / "run", attack(**METHOD))).text
    for said in (
        "The search's claim margin loss 4.5 in the render that won, 3.25 when rendered again",
        "Sample count 64 a pixel in the verification; that more would not change it is not shown",
        "Light transport a matrix predicted 37 pictures; at the last comparison with a traced one it was off by 0.812 "
        "of 255 levels of the picture's change (root mean square) and an unknown amount of the objective; made anew 1 "
        "time; it and the comparisons took 2.0 s",
        "Gradients 36 of the search, 2 of them zero, median cosine with the one before 0.25",
        "Cut or taken back 1 gradient with single outliers cut, 4 shortened as a whole, 3 steps taken back",
        "Not finite 1 objective, 7 numbers of gradients",
        "Light paths at most 6 segments in the search, 6 in the verification",
        "clean: step between neighbours 0.01, distance from printable colours 0.2; answer: step between neighbours",
        "Gradient plan: 2 parameters, 2 renders a gradient beside the picture itself, 8 samples a pixel",
        "pose.yaw 1 secant the quickest 5.4 degrees: an outline moves",
        "texture.texels 192 adjoint the only one",
    ):
        assert said in text, said
    assert text.count("at its end") == 1


@pytest.mark.medium
def test_the_page_does_not_say_what_is_not_known_of_the_search(tmp_path: Path) -> None:
    text = page_of(make_run(tmp_path / "run")).text
    assert "Light paths" in text
    assert not re.search("Gradient plan|Light transport|Not finite|Printability|taken back|at its end", text)
    used = {"used": False, "reason": "a pose is searched"}
    text = page_of(make_run(tmp_path / "other", attack(transport=used))).text
    assert "Light transport every picture was rendered: a pose is searched" in text
