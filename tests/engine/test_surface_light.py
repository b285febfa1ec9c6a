"""Searches under cameras and lights that vary by chance, by light on surfaces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import advsearch
from advsearch.attacks import make_policy
from advsearch.attacks.evaluation import Query
from advsearch.engine import acceptance, surface_light
from advsearch.engine.acceptance import ComparedView, Deviation
from advsearch.engine.surface_light import SurfaceLight
from advsearch.questions.attack.carry_out import load_parts, make_problem_with_warnings
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.attack.run import attack_once
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.store import NAME as STORE
from advsearch.runs.store import Store
from advsearch.scene.surface import arrangement, texels
from stand_ins import Impatient, rows, shared

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
            patched.setattr(surface_light, name, count)
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

    def found(self: SurfaceLight, *arguments: Any) -> Deviation:
        compare(self, *arguments)
        self.deviations[-1] = replace(self.deviations[-1], levels=next(coming), allowed_levels=3.0)
        return self.deviations[-1]

    monkeypatch.setattr(SurfaceLight, "_compare", found)


@pytest.mark.medium
def test_a_search_says_that_light_on_surfaces_predicted_it(whole: tuple[Path, AttackResult]) -> None:
    """All of its pictures, under three lights; a comparison before it, and two within, of two pictures each."""
    told, renders = whole[1].summary.transport, whole[1].summary.renders
    assert told is not None and told.conditions is not None and told.error is not None
    assert (told.way, told.reason, told.renewed, told.conditions.made) == ("surface light", None, 0, 3)
    assert told.bytes and told.entries and 0.0 < told.error.levels < 50.0
    assert (renders["products"], renders["gradient"]) == (18 * 2, 0)


@pytest.mark.medium
def test_a_search_that_goes_on_ends_with_the_same_rows(whole: tuple[Path, AttackResult], tmp_path: Path) -> None:
    """Light and comparisons are found again."""
    stopped = advsearch.attack("mug", run=tmp_path / "parts", progress=Impatient(9), **SMALL)
    assert stopped.summary.ending == "interrupted"
    advsearch.attack("mug", run=tmp_path / "parts", resume=True, **SMALL)
    assert rows(tmp_path / "parts") == rows(whole[0])


@pytest.mark.medium
def test_light_is_renewed_and_then_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two comparisons in a row are too far off: the first finds light anew, after the second pictures are traced."""
    off(monkeypatch, 1.0, 9.0, 9.0)
    summary = advsearch.attack("mug", **SMALL).summary
    assert summary.transport is not None and summary.transport.renewed == 1
    assert "from evaluation 12 on" in str(summary.transport.reason)
    assert summary.renders["products"] == 12 * 2


@pytest.mark.medium
def test_matrices_predict_what_light_on_surfaces_cannot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it is too far off before the search."""
    off(monkeypatch, 9.0)
    told = advsearch.attack("mug", **{**SMALL, "steps": 16}).summary.transport
    assert told is not None and told.way == "matrix" and "9.0 levels of 255 off" in str(told.reason)


CAMERA: dict[str, Any] = SMALL | {"controls": "camera", "over": (), "draws": None, "steps": 40, "baseline": True}


@pytest.fixture(scope="module")
def viewpoints(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, AttackResult]:
    """A search for a camera that nobody disturbed, and its result."""
    run = tmp_path_factory.mktemp("viewpoints") / "run"
    return run, advsearch.attack("mug", run=run, **CAMERA)


@pytest.mark.medium
def test_a_search_for_a_viewpoint_is_predicted_and_its_ranking_is_traced(viewpoints: tuple[Path, AttackResult]) -> None:
    """Two searches of 40 pictures, eight traced ones of each ranking; comparisons of two places after 0, 6, 12 and 24
    pictures. Rows say which were traced."""
    told, renders = viewpoints[1].summary.transport, viewpoints[1].summary.renders
    assert told is not None and (told.way, told.reason, told.conditions) == ("surface light", None, None)
    assert (renders["products"], renders["baseline"]) == (80, 8)
    assert renders["search"] == 8 + 4 * acceptance.N_FIRST_VIEWS * 3
    with Store(viewpoints[0] / STORE, read_only=True) as store:
        spp = {(row.phase, row.spp, row.renders) for kind in ("search", "baseline") for row in store.rows(kind)}
    assert spp == {("search", None, 0), ("ranking", 8, 1)}


@pytest.mark.medium
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


@pytest.mark.medium
def test_a_viewpoint_is_rendered_once_predictions_are_too_far_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """After two comparisons in a row: nothing is to be found anew. The random search is rendered, too."""
    off(monkeypatch, 1.0, 9.0, 9.0)
    summary = advsearch.attack("mug", **CAMERA).summary
    assert summary.transport is not None and summary.transport.renewed == 0
    assert "from evaluation 12 on" in str(summary.transport.reason)
    assert (summary.renders["products"], summary.renders["baseline"]) == (12, 48)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"policy": "pgd"}, "pgd takes derivatives"),
        ({"steps": 31}, "pays from 32"),
        ({"controls": ["camera", "pose"]}, "object.vertices"),
        ({"estimators": {"camera": "differences"}}, "forced"),
    ],
)
def test_a_search_for_a_viewpoint_that_renders_says_why(settings: dict[str, Any], reason: str) -> None:
    """In words; nothing is measured."""
    parts = load_parts(AttackConfig(object="mug", **{**CAMERA, **settings}))
    problem, _ = make_problem_with_warnings(parts)
    against = surface_light.find_surface_light_refusal(
        problem, problem.steps, make_policy(str(settings.get("policy", "auto"))), True
    )
    assert reason in str(against)


@pytest.mark.medium
def test_a_texture_and_its_viewpoint_are_searched_together() -> None:
    """The derivative of the texture is predicted, too; the camera is found without one."""
    summary = advsearch.attack("mug", **CAMERA | {"controls": {"texture": {"resolution": 8}, "camera": {}}}).summary
    assert summary.transport is not None and summary.transport.way == "surface light"
    assert (summary.renders["products"], summary.renders["gradient"]) == (80, 0)


def test_a_camera_that_was_drawn_is_no_progress_of_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the search has moved is the texture: before it that is nothing, whatever the camera."""
    controls = {"texture": {"resolution": 8}, "camera": {}}
    problem, _ = make_problem_with_warnings(load_parts(AttackConfig(object="mug", **CAMERA | {"controls": controls})))
    before: list[Tensor | None] = []

    def view_of(*given: Any) -> ComparedView:
        before.append(given[-1])
        return ComparedView(8.0, 9.0, 0.0, 3)

    monkeypatch.setattr("advsearch.engine.problem.compare_with_traced", view_of)
    light = SurfaceLight(problem, 40)
    light.prepare()
    assert before == [None] * acceptance.N_FIRST_VIEWS
    light._compare(problem.domain.sample(torch.Generator().manual_seed(0), 1)[0], 6)
    assert len(before) == 2 * acceptance.N_FIRST_VIEWS and all(
        one is not None for one in before[acceptance.N_FIRST_VIEWS :]
    )


@pytest.mark.medium
def test_a_random_search_looks_through_the_same_cameras_again() -> None:
    """Every fourth time, where a search that learns sees new ones and other exposures each time."""
    problem, _ = make_problem_with_warnings(load_parts(AttackConfig(object="mug", **SMALL)))
    light, u = SurfaceLight(problem, 18), problem.domain.start

    def objective(kind: str, number: int) -> float:
        return light.evaluate(Query(u, number, kind, number, gradient=False, phase="search")).objective

    light.prepare()
    assert objective("baseline", 1) == objective("baseline", 5) != objective("baseline", 2)
    assert len({objective("search", number) for number in (1, 5, 9)}) == 3
    exposures = [group.coordinates for group in problem.space.groups if group.name == "environment.exposure"]
    seen = {
        float(one[exposures[0].start - len(u)]) for n in range(9) for one in light._choose_conditions("search", n, 2)
    }
    assert len(seen) == 18 and len(light.renderer.stored_lights) <= 4
