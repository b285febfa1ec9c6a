"""Light transport as a matrix: its pictures against traced ones, its derivative against the adjoint, and searches."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import advsearch
from advsearch.engine import acceptance
from advsearch.engine import transport as searching
from advsearch.scene.mitsuba_backend.transport import PathVertices
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport import lights
from advsearch.scene.transport import matrix as linear
from advsearch.scene.transport.matrix import CELL_SIZE, TextureTransport
from small_models import levels
from stand_ins import Impatient, rows

SIZE = 64
HALF = 5e-4
"""What a share is rounded by: it has 16 bits."""


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return advsearch.load_scene("mug").renderer({"texture": {"resolution": 64}}, resolution=SIZE)


@pytest.fixture(scope="module")
def predicted(renderer: Renderer) -> linear.LinearRenderer:
    return linear.LinearRenderer(renderer, renderer.start, seed=1)


def changed(renderer: Renderer, epsilon: float, kind: str) -> Tensor:
    """A configuration `epsilon` of the range from the start: by a sign a number, or all one way."""
    generator = torch.Generator().manual_seed(2)
    way = {"signs": torch.randint(0, 2, renderer.start.shape, generator=generator) * 2.0 - 1.0}
    return (renderer.start + epsilon * way.get(kind, torch.tensor(1.0 if kind == "up" else -1.0))).clamp(0.0, 1.0)


@pytest.mark.medium
@pytest.mark.parametrize(
    ("kind", "most"), [("signs", 1.3), ("up", 2.0), pytest.param("down", 2.0, marks=pytest.mark.slow)]
)
def test_a_predicted_change_is_the_traced_one(
    renderer: Renderer, predicted: linear.LinearRenderer, kind: str, most: float
) -> None:
    """Within an epsilon of 0.1; what is left is light that meets the object twice, and noise. The two traced pictures
    of a change have the same noise."""
    u = changed(renderer, 0.1, kind)
    with torch.no_grad():
        after, before = (renderer(one, seed=11, spp=256) for one in (u, renderer.start))
        change = predicted(u) - predicted(renderer.start)
    assert levels(change, after - before) < most
    assert levels(after, before) > 3.0 * most, "the change itself is large"


@pytest.mark.medium
def test_its_derivative_is_that_of_the_adjoint(renderer: Renderer, predicted: linear.LinearRenderer) -> None:
    def loss(picture: Tensor) -> Tensor:
        return (picture * picture).mean()

    u = changed(renderer, 0.05, "signs")
    _, exact = predicted.renderer.gradient(loss, u, seed=3, spp=1)
    sampled = torch.stack([renderer.gradient(loss, u, seed=seed, spp=64)[1] for seed in range(4)]).mean(dim=0)
    assert float(torch.nn.functional.cosine_similarity(exact, sampled, dim=0)) > 0.97
    assert 0.9 < float(exact.norm() / sampled.norm()) < 1.1
    assert torch.equal(exact, predicted.renderer.gradient(loss, u, seed=4, spp=8)[1]), "nothing of it is by chance"


def vertices(rows: Sequence[tuple[int, float, float, float]], sharp: bool = True) -> PathVertices:
    """Vertices from rows of pixel, u, v and weight, that the camera sees or not."""
    table = np.array(rows, dtype=np.float32).reshape(-1, 4)
    weight = torch.from_numpy(table[:, 3:]).expand(-1, 3).contiguous()
    seen = torch.full((len(table),), sharp)
    return PathVertices(
        torch.from_numpy(table[:, 0]).long(), torch.from_numpy(table[:, 1:3]).contiguous(), weight, seen
    )


def test_a_lookup_is_bilinear_and_repeats_at_the_border() -> None:
    """One vertex in the middle of a texel, one between two, one over the corner; their weights add up."""
    made = TextureTransport((1, 3), (4, 4))
    made.add_pass([vertices([(0, 0.375, 0.625, 2.0), (1, 0.5, 0.625, 2.0), (2, 0.0, 0.0, 4.0)])], pass_weight=0.5)
    made.finish()
    texture = torch.arange(16.0).reshape(4, 4, 1).expand(-1, -1, 3).contiguous()
    seen = made.multiply(texture)[0, :, 0]
    corners = (texture[0, 0, 0] + texture[0, 3, 0] + texture[3, 0, 0] + texture[3, 3, 0]) / 4.0
    assert seen.tolist() == pytest.approx([9.0, 9.5, 2.0 * float(corners)], rel=HALF)


def test_the_transpose_is_one() -> None:
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(60, 2, generator=generator)
    rows = [(int(60 * x) % 12, float(x), float(y), float(x - y)) for x, y in places]
    made = TextureTransport((3, 4), (CELL_SIZE + 3, 2 * CELL_SIZE))
    made.add_pass([vertices(rows[:30]), vertices(rows[30:], sharp=False)], pass_weight=1.0)
    made.finish()
    change = torch.randn(CELL_SIZE + 3, 2 * CELL_SIZE, 3, generator=generator)
    cotangent = torch.randn(3, 4, 3, generator=generator)
    forward = float((made.multiply(change) * cotangent).sum())
    assert forward == pytest.approx(float((change * made.multiply_transposed(cotangent)).sum()), rel=1e-5)


@pytest.mark.parametrize(("texture", "bytes_an_entry"), [((256, 256), 4), ((257, 256), 6)])
def test_what_is_kept_small_says_the_same(texture: tuple[int, int], bytes_an_entry: int) -> None:
    """A column takes 16 bits, where 65,536 texels are not too many for that."""
    seen = [vertices([(0, 0.3, 0.3, 1.0), (0, 0.999, 0.999, 3.0), (1, 0.7, 0.2, 1.0)])]
    made, small = (TextureTransport((1, 2), texture, small=one) for one in (False, True))
    for one in (made, small):
        one.add_pass(seen, pass_weight=1.0)
        one.finish()
    change = torch.rand(*texture, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(small.multiply(change), made.multiply(change), rtol=HALF, atol=0.0)
    cotangent = torch.ones(1, 2, 3)
    both = small.multiply_transposed(cotangent), made.multiply_transposed(cotangent)
    torch.testing.assert_close(*both, rtol=2 * HALF, atol=1e-6)
    assert small.n_bytes == bytes_an_entry * small._sharp.entries + 2 * (4 + 6) * 2


@pytest.mark.parametrize(
    ("controls", "options", "can_predict"),
    [
        (["texture"], {}, True),
        pytest.param(["patch"], {}, True, marks=pytest.mark.island("advsearch.controls.patch")),
        (["texture", "pose"], {}, False),
        pytest.param(
            {"texture": {}, "haze": {"density": 0.2}}, {}, False, marks=pytest.mark.island("advsearch.controls.haze")
        ),
        (["texture"], {"denoise": "none"}, False),
        (["texture"], {"estimators": {"texture": "adjoint"}}, False),
    ],
)  # fmt: skip
def test_where_it_can_predict(controls: object, options: dict[str, object], can_predict: bool) -> None:
    made = advsearch.load_scene("mug").renderer(controls, resolution=16, **options)  # type: ignore[arg-type]
    assert (lights.find_refusal(made) is None) == can_predict


SMALL = {"resolution": SIZE, "trials": 6, "steps": 18, "verify_spp": 8, "controls": {"texture": {"resolution": 8}}}


@pytest.mark.medium
def test_the_smallest_budget_is_sought_with_one_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    made, guesses = 0, 0
    linearised, likely = lights.make_predictor, searching.Transport.is_likely_success

    def counted(*given: Any) -> Any:
        nonlocal made
        made += 1
        return linearised(*given)

    def guessed(self: searching.Transport, u: Tensor) -> bool:
        nonlocal guesses
        guesses += 1
        return likely(self, u)

    monkeypatch.setattr(searching, "make_predictor", counted)
    monkeypatch.setattr(searching.Transport, "is_likely_success", guessed)
    monkeypatch.setattr(acceptance, "MIN_ALLOWED_LEVELS", 100.0)
    found = advsearch.attack("mug", smallest=True, baseline=False, run=None, **SMALL).summary  # type: ignore[arg-type]
    assert found.smallest is not None and found.smallest.epsilon is not None and found.smallest.searches > 1
    assert made == 1 and guesses >= 5


@pytest.mark.medium
def test_a_search_says_what_predicted_its_pictures_and_one_that_goes_on_ends_with_the_same_rows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It compares, and makes the matrix anew where that is off. What is read back is not predicted again: the matrix
    was made anew once before the interrupt."""
    monkeypatch.setattr(searching, "COMPARISON_INTERVAL", 6)
    monkeypatch.setattr(acceptance, "MAX_MARGIN_BIAS", 0.0)
    monkeypatch.setattr(acceptance, "MAX_BIAS_FRACTION", 0.0)
    settings: Any = {**SMALL, "baseline": False, "deterministic": True}
    found = advsearch.attack("mug", run=tmp_path / "whole", **settings)
    told, renders = found.summary.transport, found.summary.renders
    assert told is not None and told.used and told.entries and told.error and told.error.levels >= 0.0
    assert told.renewed == 2 and renders["products"] == 18 and renders["gradient"] == 0
    kept = json.loads((tmp_path / "whole" / "summary.json").read_text())
    assert kept["transport"]["renewed"] == 2
    stopped = advsearch.attack("mug", run=tmp_path / "parts", progress=Impatient(9), **settings)
    assert stopped.summary.ending == "interrupted"
    advsearch.attack("mug", run=tmp_path / "parts", resume=True, **settings)
    assert rows(tmp_path / "parts") == rows(tmp_path / "whole")


@pytest.mark.medium
def test_what_it_starts_from_is_the_traced_picture(renderer: Renderer, predicted: linear.LinearRenderer) -> None:
    with torch.no_grad():
        one, other = (renderer(renderer.start, seed=seed, spp=256) for seed in (11, 12))
        assert levels(predicted(renderer.start), one) < 1.5 * levels(one, other)


def test_smoothed_rows_keep_where_they_look_and_take_the_sum_that_is_asked_for() -> None:
    made = TextureTransport((1, 2), (CELL_SIZE, CELL_SIZE))
    made.add_pass([vertices([(0, 0.3, 0.3, 1.0), (0, 0.8, 0.3, 3.0), (1, 0.3, 0.3, 1.0)])], pass_weight=1.0)
    made.finish(lambda picture: torch.full_like(picture, 2.0))
    ones = torch.ones(CELL_SIZE, CELL_SIZE, 3)
    assert made.multiply(ones)[0, :, 0].tolist() == pytest.approx([2.0, 2.0], rel=HALF)
    left = ones.clone()
    left[:, CELL_SIZE // 2 :] = 0.0
    assert made.multiply(left)[0, :, 0].tolist() == pytest.approx([0.5, 2.0], rel=HALF, abs=1e-6)


def test_a_guess_learns_how_optimistic_a_prediction_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scores of 4 on average, 19 of 20 of them over 3.1; a prediction of 5 was 1.9 too good."""
    monkeypatch.setattr(searching.Transport, "_predict_score", lambda self, u: float(u))
    problem: Any = None
    made = searching.Transport(problem, 1)
    assert made.is_likely_success(torch.tensor(0.1)) and not made.is_likely_success(torch.tensor(-0.1))
    made.update_score_bias(torch.tensor(5.0), [3.5, 4.5] * 4)
    for scores in ([1.0, 2.0], [math.nan] * 6):  # too few to say anything, or none
        made.update_score_bias(torch.tensor(9.0), scores)
    assert not made.is_likely_success(torch.tensor(1.7)) and made.is_likely_success(torch.tensor(2.0))
