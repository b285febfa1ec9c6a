"""Searches under cameras and lights that vary by chance, by light on surfaces."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import advsearch
from advsearch.engine import acceptance
from advsearch.engine.acceptance import Deviation
from advsearch.predictors.surface_light import arrangement, texels
from advsearch.predictors.surface_light import search as surface_search
from advsearch.predictors.surface_light.search import SurfaceLight
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.attack.run import attack_once
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.store import NAME as STORE
from advsearch.runs.store import Store
from stand_ins import Impatient, rows, shared

pytestmark = [pytest.mark.medium, pytest.mark.island("advsearch.predictors.surface_light")]

SMALL: dict[str, Any] = {
    "resolution": 32,
    "controls": {"texture": {"resolution": 8}},
    "over": ["camera", "environment"],
    "draws": 2,
    "steps": 18,
    "trials": 6,
    "verify_spp": 4,
    "baseline": False,
    "deterministic": True,
}


@pytest.fixture(autouse=True, scope="module")
def coarse() -> Iterator[None]:
    """Few texels, rays and lights, and a comparison every six evaluations."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(texels, "GROUND_TEXELS", 32)
        for name, value in {"OBJECT_TEXELS": 48, "RAYS_PER_TEXEL": 64}.items():
            patched.setattr(arrangement, name, value)
        for name, count in {"N_LIGHTS": 3, "COMPARISON_INTERVAL": 6}.items():
            patched.setattr(surface_search, name, count)
        for name, number in {"CHECK_SPP": 4, "MIN_ALLOWED_LEVELS": 50.0, "MAX_MARGIN_BIAS": 50.0}.items():
            patched.setattr(acceptance, name, number)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, AttackResult]:
    """A run that nobody disturbed, and its result."""
    run = tmp_path_factory.mktemp("whole") / "run"
    return run, advsearch.attack("mug", run=run, **SMALL)


def off(monkeypatch: pytest.MonkeyPatch, *levels: float) -> None:
    """Let comparisons find that predictions are so far off, one after the other, where 3 would do."""
    coming = iter(levels)
    compare = SurfaceLight._compare

    def found(self: SurfaceLight, u: Any, index: int) -> Deviation:
        compare(self, u, index)
        self.deviations[-1] = replace(self.deviations[-1], levels=next(coming), allowed_levels=3.0)
        return self.deviations[-1]

    monkeypatch.setattr(SurfaceLight, "_compare", found)


def test_a_search_that_goes_on_ends_with_the_same_rows(whole: tuple[Path, AttackResult], tmp_path: Path) -> None:
    """Light and comparisons are found again."""
    stopped = advsearch.attack("mug", run=tmp_path / "parts", progress=Impatient(9), **SMALL)
    assert stopped.summary.ending == "interrupted"
    advsearch.attack("mug", run=tmp_path / "parts", resume=True, **SMALL)
    assert rows(tmp_path / "parts") == rows(whole[0])


def test_light_is_renewed_and_then_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two comparisons in a row are too far off: the first finds light anew, after the second pictures are traced."""
    off(monkeypatch, 1.0, 9.0, 9.0)
    summary = advsearch.attack("mug", **SMALL).summary
    assert summary.transport is not None and summary.transport.renewed == 1
    assert "from evaluation 12 on" in str(summary.transport.reason)
    assert summary.renders["products"] == 12 * 2


def test_matrices_predict_what_light_on_surfaces_cannot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it is too far off before the search."""
    off(monkeypatch, 9.0)
    told = advsearch.attack("mug", **{**SMALL, "steps": 16}).summary.transport
    assert told is not None and told.method == "matrix" and "9.0 levels of 255 off" in str(told.reason)


CAMERA: dict[str, Any] = SMALL | {"controls": "camera", "over": (), "draws": None, "steps": 40, "baseline": True}


@pytest.fixture(scope="module")
def viewpoints(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, AttackResult]:
    """A search for a camera that nobody disturbed, and its result."""
    run = tmp_path_factory.mktemp("viewpoints") / "run"
    return run, advsearch.attack("mug", run=run, **CAMERA)


def test_a_search_for_a_viewpoint_is_predicted_and_its_ranking_is_traced(viewpoints: tuple[Path, AttackResult]) -> None:
    """Two searches of 40 pictures, eight traced ones of each ranking; comparisons of two places after 0, 6, 12 and 24
    pictures. Rows say which were traced."""
    told, renders = viewpoints[1].summary.transport, viewpoints[1].summary.renders
    assert told is not None and (told.method, told.reason, told.conditions) == ("surface light", None, None)
    assert (renders["products"], renders["baseline"]) == (80, 8)
    assert renders["search"] == 8 + 4 * acceptance.N_FIRST_VIEWS * 3
    with Store(viewpoints[0] / STORE, read_only=True) as store:
        spp = {(row.phase, row.spp, row.renders) for kind in ("search", "baseline") for row in store.rows(kind)}
    assert spp == {("search", None, 0), ("ranking", 8, 1)}


@pytest.mark.slow
def test_a_search_for_a_viewpoint_goes_on_with_the_same_rows(
    viewpoints: tuple[Path, AttackResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the middle of pictures that were asked for at once; and with workers, who trace."""
    ready = shared(monkeypatch, {"object": "mug", **CAMERA})
    folder = tmp_path / "parts"
    config = AttackConfig(**CAMERA, object="mug", workers=2, run=str(folder))
    stopped = attack_once(config, progress=Impatient(9))
    assert stopped.summary.ending == "interrupted"
    attack_once(config, resumed=folder)
    assert ready.given and rows(folder) == rows(viewpoints[0])
