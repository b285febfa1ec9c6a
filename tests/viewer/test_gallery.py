"""Searching, grouping and comparing the pictures of sweeps, in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from test_browser import browser, faults, opened, until  # noqa: F401  the fixture that starts Chromium

import advsearch
import small_models
from advsearch.questions.sweep.page import write_bundle
from stored_sweeps import make_sweep, serving

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.medium

HOSTILE = "<img src=x onerror=document.title='planted'>"


def sought(page: Page, text: str) -> int:
    """How many configurations the page finds."""
    page.get_by_label("Search").fill(text)
    wanted = "24 configurations" if not text else " of 24 configurations"
    until(page, lambda: wanted in page.locator("#explorer .status").inner_text())
    page.wait_for_timeout(300)  # the page waits until nobody types
    return int(page.locator("#explorer .status").inner_text().split()[0])


def test_rows_are_found_by_words_and_by_rules(browser: Browser, tmp_path: Path) -> None:  # noqa: F811
    run = make_sweep(tmp_path / "run", keep="all", environments=("noon", HOSTILE))
    with opened(browser, (run / "report.html").as_uri(), 390, bypass_csp=True) as page:
        page.wait_for_selector("[data-cell]")
        counts = {
            "cup": 6,
            "noon": 12,
            "noon mug": 6,
            "environment noon": 12,
            f"environment noon or {HOSTILE}": 24,
            "camera.elevation over 30 degrees": 12,
            "camera.elevation over 5 and at most 30 degrees and pose.yaw over 40": 8,
            "pose.yaw from 340 to 20 degrees": 8,
            "pose.yaw from 340 to 20 or from 80 to 100 degrees": 16,
            "environment noon and camera.elevation over 30 degrees": 6,
            "7": 1,
            "(nothing [is called so": 0,
        }
        assert {text: sought(page, text) for text in counts} == counts
        assert page.locator(".card").count() == 0
        assert sought(page, "environment noon and camera.elevation over 30 degrees") == 6
        assert page.locator(".card").count() == 6 and page.locator(".card.wrong").count() == 6
        address = page.url
        assert faults(page) == []
        page.goto("about:blank")
        page.goto(address)
        page.wait_for_selector("[data-cell]")
        assert page.locator(".card").count() == 6  # the address says what was sought
        assert page.get_by_label("Search").input_value().startswith("environment noon and")


def test_two_runs_stand_beside_each_other_picture_by_picture(browser: Browser, tmp_path: Path) -> None:  # noqa: F811
    first = make_sweep(tmp_path / "first", keep="all")
    second = make_sweep(tmp_path / "second", keep="all", environments=("studio", "noon"))  # wrong in the other half
    write_bundle([first, second], tmp_path / "site")
    with opened(browser, (tmp_path / "site" / "index.html").as_uri(), 390) as page:  # as a double click does
        page.wait_for_selector(".card .beside img")
        assert page.locator(".card").first.locator("img").count() == 2
        assert page.locator(".card").count() == 24  # each configuration once
        page.get_by_label("Show", exact=True).select_option("differ")
        assert page.locator(".card").count() == 12
        said = page.locator(".card").first.inner_text()
        assert "✗ first: cup" in said and "✓ second: mug" in said
        page.get_by_label("Show", exact=True).select_option("right")
        page.get_by_label("Group by").select_option("run")
        assert page.locator("#explorer h3").all_inner_texts() == ["first 12 of 24", "second 12 of 24"]
        page.locator(".card").first.click()
        assert page.locator("dialog img").count() == 2
        assert "first\tsecond" in page.locator("dialog .facts").inner_text()


def test_all_boxes_are_drawn_with_their_names(browser: Browser, tmp_path: Path) -> None:  # noqa: F811
    found = [{"box": [1.0, 1.0, 5.0, 6.0], "label": HOSTILE, "score": 0.2}]
    found += [{"box": [4.0, 4.5, 12.0, 12.0], "label": "mug", "score": 0.6}]
    things = {"object": {"box": [4, 4, 12, 12]}, "a bowl": {"box": [0, 9, 3, 14]}, "far away": {"box": None}}
    payload: Any = {"box": [4, 4, 12, 12], "found": found, "things": things}
    run = make_sweep(tmp_path / "boxes", keep="all", payload=payload, label="mug", task="detection")
    with opened(browser, (run / "report.html").as_uri()) as page:
        page.wait_for_selector(".card svg")
        page.get_by_label("Show", exact=True).select_option("right")
        card = page.locator(".card").first
        assert (card.locator("rect.true").count(), card.locator("rect.said").count()) == (2, 1)
        assert card.locator("rect.other").count() == 0  # its score is under one half
        card.click()
        names = page.locator("dialog svg text").all_text_contents()
        assert sorted(names) == sorted(["object", "a bowl", "mug 0.60", f"{HOSTILE} 0.20"])
        assert page.locator("dialog rect.other").count() == 1


def test_the_page_of_a_drive_begins_with_the_drive(browser: Browser, tmp_path: Path) -> None:  # noqa: F811
    found = advsearch.sweep(
        "mug", small_models.easy(), {"pose.yaw": [0.0, 90.0]}, path="approach", fps=0.5, spp=1, resolution=16,
        denoise="none", trials=0, run=tmp_path / "drive", keep_pictures="all",
    )  # fmt: skip
    assert found.summary.drives is not None
    frames = found.summary.drives[0].frames
    assert frames > 3
    for address in ((tmp_path / "drive" / "report.html").as_uri(), None):
        with serving(tmp_path / "drive") as server:
            with opened(browser, address or f"{server.address}runs/drive/") as page:
                page.wait_for_selector("[data-cell]")
                roles = [page.get_by_label(f"{name}: how it is shown") for name in ("path.time", "drive")]
                assert [one.input_value() for one in roles] == ["across", "up"]
                assert page.locator("[data-cell]:not(.none)").count() == 2 * frames  # no diagonal
                heads = page.locator("#explorer h3").all_inner_texts()
                assert heads == [f"Drive 1, pose.yaw 0 {frames}", f"Drive 2, pose.yaw 90 {frames}"]
                first = page.locator(".card").first
                first.click()
                assert "path.time [s]\t0" in page.locator("dialog .facts").inner_text()
                page.get_by_role("button", name="Next").click()
                assert "path.time [s]\t0" not in page.locator("dialog .facts").inner_text()
