"""Sweeps: the product that is never built, the values that are rendered, what is counted, and what survives.

The renderer is replaced by a picture that depends on the configuration and the seed, except in one test.
"""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from torch import Tensor

import advsearch
from advsearch.attacks.domain import POINTS_PER_NET as NET
from advsearch.attacks.domain import ProductIndex, SampleSequence
from advsearch.controls import CONTROLS, make_control, make_space
from advsearch.controls.base import Parameter
from advsearch.engine.judging import make_domain
from advsearch.errors import InputError, RunExistsError
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.sweep import job as swept_scene
from advsearch.questions.sweep.axes import (
    SceneConfigurations,
    add_grid_axes,
    choose_n_parts,
    parse_axes,
    parse_axis_values,
)
from advsearch.questions.sweep.job import KIND
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results import to_json_value
from advsearch.runs.summary import write_configuration
from advsearch.scene.formation import ImageFormation
from advsearch.scene.gradients import GradientPlan
from advsearch.statistics.intervals import clopper_pearson
from covering import once_each
from samples import PHOTOGRAPHS, write_photograph_folder
from samples import attack as attack_result
from small_models import Brightness

SIZE = 16
LABELS = ("mug", "vase")
YAW = next(one for one in CONTROLS["pose"].parameters if one.name == "yaw")
ELEVATION = next(one for one in CONTROLS["camera"].parameters if one.name == "elevation")

NOISE = 0.05


def kept(seen: list[Any], thing: Any, answer: Any) -> Any:
    """Note a thing and answer, where an expression has to do both."""
    seen.append(thing)
    return answer


class FakeRenderer:
    """A picture whose grey level is a smooth function of u plus noise that the seed decides."""

    made: list[FakeRenderer]
    stops_at: int | None = None
    stops_with: type[BaseException] = KeyboardInterrupt
    calls = 0
    level: float | None = None
    composition_reason = ""

    def __init__(
        self, scene: Any, space: Any, size: tuple[int, int], denoise: str, seed: int, sampler: str = "independent"
    ) -> None:
        self.space, self.size, self.n_non_finite = space, size, 0
        self.start, self.scene = space.start, SimpleNamespace(input_assembler=dict)  # nothing of it is light
        self.formation, self.plan = ImageFormation(denoiser=denoise, resolution=size), GradientPlan(())
        self.seen: list[tuple[Tensor, int, int]] = []
        self.share_paths = nullcontext
        FakeRenderer.made.append(self)

    def __call__(self, u: Tensor, seed: int, spp: int) -> Tensor:
        if FakeRenderer.stops_at is not None and FakeRenderer.calls >= FakeRenderer.stops_at:
            raise FakeRenderer.stops_with("stopped by the test")
        FakeRenderer.calls += 1
        assert u.dtype == torch.float32 and bool(((u >= 0) & (u <= 1)).all())
        self.seen.append((u.clone(), seed, spp))
        wave = float(torch.sin(u.double() * torch.arange(1.0, len(u) + 1.0)).sum()) if len(u) else 0.0
        level = 0.5 + 0.3 * math.sin(3.0 * wave) + NOISE * (seed / 2**32 - 0.5)
        return torch.full((*self.size, 3), level if FakeRenderer.level is None else FakeRenderer.level)


@pytest.fixture(autouse=True)
def fake(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is rendered, unless the test is marked so by its name."""
    FakeRenderer.made, FakeRenderer.calls, FakeRenderer.stops_at, FakeRenderer.level = [], 0, None, None
    FakeRenderer.stops_with = KeyboardInterrupt
    if "really_rendered" not in request.node.name:
        monkeypatch.setattr(swept_scene, "make_renderer", FakeRenderer)


def model(threshold: float = 0.55, name: str = "brightness", size: int = SIZE) -> advsearch.Model:
    return advsearch.load_model(Brightness(threshold, slope=20.0), labels=LABELS, input_size=size, name=name)


def rows_of(run: Path) -> list[tuple[Any, ...]]:
    """Every stored value but the times."""
    with RunDirectory.resume(run) as opened:
        return [(*(getattr(row, name) for name in COMPARED), json.dumps(row.values)) for row in opened.store.rows()]


COMPARED = (
    "kind",
    "step",
    "seed",
    "spp",
    "objective",
    "score",
    "success",
    "correct",
    "margin",
    "label",
    "label_index",
    "probability",
    "renders",
)
TIMES = ("seconds", "renders_per_second", "run", "command_line")


def timeless(summary: SweepSummary) -> dict[str, Any]:
    return {name: value for name, value in summary.to_dict().items() if name not in TIMES}


GRID = {"pose.yaw": "0:360:6", "camera.elevation": [5, 20, 35]}


@examples(max_examples=200, deadline=None)
@given(sizes=st.lists(st.integers(1, 10**6), max_size=6).map(tuple), data=st.data())
def test_digits_and_numbers_are_inverse(sizes: tuple[int, ...], data: st.DataObject) -> None:
    product = ProductIndex(sizes)
    assert product.count == math.prod(sizes)
    index = data.draw(st.integers(0, product.count - 1))
    digits = product.digits(index)
    assert all(0 <= digit < size for digit, size in zip(digits, sizes, strict=True))
    assert product.index(digits) == index


@pytest.mark.parametrize("sampler", ["sobol", "random"])
def test_a_draw_is_the_same_from_wherever_it_is_asked(sampler: str) -> None:
    numbers = [0, 1, 100, NET - 1, NET, NET + 5, 3 * NET + 7, 10**12]
    whole = SampleSequence(3, sampler, 7).points(0, NET + 10)
    assert whole.shape == (NET + 10, 3) and 0.0 <= whole.min() and whole.max() < 1.0
    ahead = {n: SampleSequence(3, sampler, 7).points(n, 1)[0] for n in numbers}
    back = SampleSequence(3, sampler, 7)
    for number in reversed(numbers):
        np.testing.assert_array_equal(back.points(number, 1)[0], ahead[number])
        if number < len(whole):
            np.testing.assert_array_equal(whole[number], ahead[number])
    assert not np.array_equal(SampleSequence(3, sampler, 8).points(0, 4), whole[:4])
    np.testing.assert_array_equal(SampleSequence(3, sampler, 7).points(NET - 5, 10), whole[NET - 5 : NET + 5])


@pytest.mark.parametrize(
    ("parameter", "given", "values"),
    [
        (YAW, "0:360:24", [15.0 * k for k in range(24)]), (YAW, "0:90:4", [0.0, 30.0, 60.0, 90.0]),
        (ELEVATION, "5:60:8", [float(v) for v in np.linspace(5, 60, 8)]),
        (ELEVATION, [np.int64(10), np.float64(30)], [10.0, 30.0]),
    ],
)  # fmt: skip
def test_values_of_an_axis(parameter: Parameter, given: Any, values: list[float]) -> None:
    assert list(parse_axis_values("--grid x", parameter, given)) == values


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("pose.yaw", "0:360:2.5"), ("pose.yaw", "0:nan:3"), ("pose.yaw", "0:360:0"), ("pose.yaw", "360:0:24"),
        ("pose.yaw", "-4000:-3900:3"), ("pose.yaw", [0, 90, 360]), ("pose.yaw", [0, math.nan]), ("pose.yaw", []),
        ("poze.yaw", [1, 2]), ("pose", [1, 2]), ("pose.rotation", [1, 2]),
    ],
)  # fmt: skip
def test_a_wrong_axis_is_named(name: str, values: Any) -> None:
    with pytest.raises(InputError, match=name):
        parse_axes({name: values}, ())


@pytest.fixture(scope="module")
def scene() -> advsearch.Scene:
    return advsearch.load_scene("mug")


def points_of(
    scene: advsearch.Scene, grid: dict[str, Any], drawn: tuple[Any, ...] = (), samples: int = 1
) -> SceneConfigurations:
    axes = parse_axes(grid, drawn)
    space = make_space(add_grid_axes(drawn, axes, scene.description), scene.description)
    return SceneConfigurations(space, make_domain(space.controls), axes, samples, "sobol", 0)


def test_what_is_rendered_is_what_was_listed(scene: advsearch.Scene) -> None:
    grid = {"pose.yaw": "0:360:24", "camera.elevation": [10, 12.3, 50], "environment.which": ["noon", "own", "kitchen"]}
    axes = parse_axes(grid, ())
    points = points_of(scene, grid)
    space = make_space(add_grid_axes((), axes, scene.description), scene.description)
    assert points.n_images == 24 * 3 * 3
    u = points.make_configurations(0, points.n_images)
    listed = list(itertools.product(*(axis.values for axis in axes)))
    for one, wanted, said in zip(u, listed, points.describe_images(u, 0), strict=True):
        shown = space.describe(one)
        assert list(said) == ["pose.yaw", "camera.elevation", "environment.which"]
        for axis, value in zip(axes, wanted, strict=True):
            assert said[axis.name] == {"value": value, "unit": shown[axis.name]["unit"]}
            rendered = shown[axis.name]["value"]
            assert rendered == (value if isinstance(value, str) else float(np.float32(value)))


@pytest.mark.medium
@pytest.mark.parametrize(
    "control",
    ["pose", "camera", "light", "lens", "corruption", "background", "material", "occlusion", "environment", "haze"],
)
def test_the_fast_way_says_what_the_control_says(scene: advsearch.Scene, control: str) -> None:
    drawn = (make_control(control),)
    points = points_of(scene, {}, drawn, samples=16)
    space = make_space(drawn, scene.description)
    u = points.make_configurations(3, 10)
    for one, said in zip(u, points.describe_images(u, 3), strict=True):
        assert said == space.describe(one)


def test_draws_stay_in_their_budget_and_cover_it(scene: advsearch.Scene) -> None:
    drawn = (
        make_control("texture", {"resolution": 16, "epsilon": 0.1}),
        make_control("environment", {"harmonics": [-1, 1], "epsilon": 0.4}),
        make_control("pose", {"yaw": [0, 360], "scale": [0.5, 2.0]}),
    )
    points = points_of(scene, {}, drawn, samples=200)
    space = make_space(drawn, scene.description)
    domain = make_domain(space.controls)
    u = points.make_configurations(0, 200)
    assert all(domain.contains(one) for one in u)
    texels = (u[:, : 16 * 16 * 3] - space.start[: 16 * 16 * 3]).abs()
    assert 0.09 < float(texels.max()) <= 0.1 + 1e-6
    values = points.describe_images(u, 0)
    scales = [math.log2(float(one["pose.scale"]["value"])) for one in values]
    assert abs(np.mean(scales)) < 0.02 and min(scales) < -0.95 and max(scales) > 0.95
    assert [one.name for one in points.sampled_numbers] == ["pose.yaw", "pose.scale"]
    assert torch.equal(points.make_configurations(150, 3), u[150:153])


def test_a_million_million_points_start_at_once(scene: advsearch.Scene) -> None:
    grid = {"pose.yaw": "0:360:10000", "camera.elevation": "5:60:10000", "pose.x": "-0.1:0.1:10000"}
    axes = parse_axes(grid, ())
    space = make_space(add_grid_axes((), axes, scene.description), scene.description)
    began = time.process_time()
    points = SceneConfigurations(space, make_domain(space.controls), axes, 1, "sobol", 0)
    assert points.n_images == 10**12
    said = points.describe_images(points.make_configurations(10**12 - 8, 8), 10**12 - 8)
    assert time.process_time() - began < 10.0
    assert [round(float(said[-1][name]["value"]), 6) for name in grid] == [359.964, 60.0, 0.1]


@pytest.mark.medium
def test_counts_are_those_of_the_rows(tmp_path: Path) -> None:
    result = advsearch.sweep("mug", model(), GRID, controls="camera.azimuth", samples=10, run=tmp_path / "run")
    summary = result.summary
    rows = list(result.rows())
    assert len(rows) == summary.configurations == summary.planned == 6 * 3 * 10
    right = [row for row in rows if row.margin is not None and row.margin >= 0.0]
    assert [row.correct for row in rows] == [row in right for row in rows]
    assert all(row.success is None for row in rows)
    assert 0 < len(right) < len(rows)
    assert summary.correct == len(right) and summary.accuracy == len(right) / len(rows)
    assert summary.interval == clopper_pearson(len(right), len(rows))
    assert summary.answers == {"vase": len(rows) - len(right)}
    by_axis = {(row.axis, str(row.value)): row for row in summary.axes}
    assert len(by_axis) == len(summary.axes) == 6 + 3 + choose_n_parts(len(rows))
    for name in GRID:
        for value in {row.values[name]["value"] for row in rows}:
            mine = [row for row in rows if row.values[name]["value"] == value]
            good = sum(row in right for row in mine)
            found = by_axis[name, str(value)]
            assert (found.configurations, found.correct) == (len(mine), good)
            assert found.interval == clopper_pearson(good, len(mine))
    for row in summary.axes:
        if row.axis == "camera.azimuth":
            assert isinstance(row.value, tuple)
            low, high = row.value
            inside = [one for one in rows if low <= float(one.values["camera.azimuth"]["value"]) < high]
            assert row.unit == "degrees" and row.configurations == len(inside) > 15
            assert row.correct == sum(one in right for one in inside)
    assert json.loads((tmp_path / "run" / "summary.json").read_text("utf-8")) == summary.to_dict()


@pytest.mark.medium
def test_the_worst_is_the_smallest_margin_and_is_rendered_again(tmp_path: Path) -> None:
    result = advsearch.sweep("mug", model(), GRID, run=tmp_path / "run", trials=7, verify_spp=36)
    rows = list(result.rows())
    worst = result.summary.worst
    assert worst is not None and worst.verified is not None
    best = max(rows, key=lambda row: row.score or -math.inf)
    assert worst.configuration == best.step and worst.claimed.margin == -(best.score or 0.0)
    assert to_json_value(worst.values) == best.values and worst.seed == best.seed and worst.claimed.label == "vase"
    checked = worst.verified
    assert (checked.successes, checked.trials, checked.spp) == (7, 7, 36) and checked.labels == {"vase": 7}
    with RunDirectory.resume(tmp_path / "run") as run:
        trials = list(run.store.rows("verification"))
    assert [row.step for row in trials] == list(range(7)) and len({row.seed for row in trials}) == 7
    assert not {row.seed for row in trials} & {row.seed for row in rows}
    (renderer,) = FakeRenderer.made
    at = renderer.seen[best.step][0]
    assert all(torch.equal(u, at) and spp == 36 for u, _, spp in renderer.seen[18:25])
    assert (tmp_path / "run" / "images" / "worst.png").is_file()
    assert result.summary.renders == {"sweep": 18, "verification": 7}


@pytest.mark.medium
def test_objects_environments_and_models_are_outer_axes(tmp_path: Path) -> None:
    models = [model(0.5, "strict"), model(0.9, "easy")]
    result = advsearch.sweep(
        ["mug", "bowl"],
        models,
        {"pose.yaw": [0, 90, 180]},
        environment="studio,noon",
        label="mug",
        run=tmp_path / "run",
    )
    rows = list(result.rows())
    places = [
        (row.values["object"]["value"], row.values["environment"]["value"], row.values["model"]["value"])
        for row in rows
    ]
    wanted = itertools.product(("mug", "bowl"), ("studio", "noon"), range(3), ("strict", "easy"))
    assert places == [(thing, light, name) for thing, light, _, name in wanted]
    assert [row.step for row in rows] == list(range(24))
    for first, second in zip(rows[::2], rows[1::2], strict=True):
        assert first.seed == second.seed and (first.renders, second.renders) == (1, 0)
        assert first.values["pose.yaw"] == second.values["pose.yaw"]
    assert len(FakeRenderer.made) == 4 or len(FakeRenderer.made) == 5  # the worst one may be loaded again
    assert result.summary.renders["sweep"] == 12
    accuracy = {row.value: row.accuracy for row in result.summary.axes if row.axis == "model"}
    assert accuracy["easy"] == 1.0 > (accuracy["strict"] or 0.0)
    assert {row.axis for row in result.summary.axes} == {"object", "environment", "model", "pose.yaw"}


def test_outputs_that_are_not_finite_are_counted_and_not_right() -> None:
    class Fails(Brightness):
        def forward(self, images: Tensor) -> Tensor:
            logits = super().forward(images)
            return torch.where(images.mean(dim=(1, 2, 3))[:, None] > 0.6, math.nan, logits)

    victim = advsearch.load_model(Fails(0.55, slope=20.0), labels=LABELS, input_size=SIZE, name="fails")
    result = advsearch.sweep("mug", victim, {"pose.yaw": "0:360:40"}, trials=0)
    bad = [row for row in result.rows() if row.score is None]
    assert bad and all((row.correct, row.margin) == (False, None) for row in bad)
    assert result.summary.not_finite == len(bad)
    assert any("not numbers; they count as not right" in text for text in result.summary.warnings)
    assert all((row.label, row.label_index) == (None, None) for row in bad)
    assert result.summary.worst is not None and math.isfinite(result.summary.worst.claimed.margin)


SURVIVES: dict[str, Any] = {
    "grid": {"pose.yaw": "0:360:6", "camera.elevation": [5, 20, 35]},
    "controls": {"camera": {"azimuth": [0, 90]}},
    "samples": 3,
    "batch": 4,
    "trials": 6,
    "environment": "studio,noon",
}


PICTURES, WHOLE = 2 * 6 * 3 * 3, 108 + 8 + 6 + 1
"""Pictures of that sweep, and all renders: two rungs of four that choose a sample count, trials, the picture kept."""


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[list[Any], dict[str, Any]]]:
    path = tmp_path_factory.mktemp("whole") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(swept_scene, "make_renderer", FakeRenderer)
        FakeRenderer.made, FakeRenderer.calls = [], 0
        summary = advsearch.sweep("mug", model(), run=path, **SURVIVES).summary
        assert FakeRenderer.calls == WHOLE
    yield rows_of(path), timeless(summary)


@pytest.mark.medium
@once_each("stops_at, kind", [1, 5, 54, 107, 109, 121], [KeyboardInterrupt, MemoryError])
def test_a_sweep_that_was_stopped_ends_as_one_that_was_not(
    tmp_path: Path, uninterrupted: Any, stops_at: int, kind: type[BaseException]
) -> None:
    path = tmp_path / "run"
    FakeRenderer.stops_at, FakeRenderer.stops_with = stops_at, kind
    if kind is KeyboardInterrupt:
        first = advsearch.sweep("mug", model(), run=path, **SURVIVES).summary
        assert first.ending == "interrupted" and first.configurations <= stops_at
        assert first.configurations == len([row for row in rows_of(path) if row[0] == KIND])
    else:
        with pytest.raises(kind):
            advsearch.sweep("mug", model(), run=path, **SURVIVES)
    FakeRenderer.stops_at = None
    before = FakeRenderer.calls
    again = advsearch.sweep("mug", model(), run=path, **SURVIVES)
    rows, summary = uninterrupted
    assert rows_of(path) == rows
    assert timeless(again.summary) == summary
    rendered_again = FakeRenderer.calls - before - (WHOLE - stops_at)
    assert 0 <= rendered_again < (5 if stops_at < PICTURES else 9)  # a look and a batch; or what chose the sample count


def kept_configuration(folder: Path, controls: dict[str, Any], answer: list[float]) -> Path:
    """Make a run of an attack whose answer is put in by hand."""
    config = AttackConfig(object="mug", controls=controls, over={"camera": {"elevation": [5, 60]}}, run=str(folder))
    with RunDirectory.create_for(config) as run:
        run.write_summary(attack_result(run=str(folder), ending="interrupted", verified=None))
        write_configuration(run.path, np.array(answer, dtype=np.float32))
    return folder


@pytest.mark.medium
def test_a_small_sweep_really_rendered_is_repeatable(tmp_path: Path) -> None:
    """Bit for bit, and each picture is that of `render` at the listed values."""
    grid = {"pose.yaw": [0, 180], "camera.elevation": [10, 60]}
    options: dict[str, Any] = {"spp": 1, "trials": 6, "verify_spp": 2, "resolution": (16, 16), "batch": 2}
    first = advsearch.sweep("mug", model(), grid, run=tmp_path / "a", **options)
    second = advsearch.sweep("mug", model(), grid, run=tmp_path / "b", **options)
    assert rows_of(tmp_path / "a") == rows_of(tmp_path / "b")
    assert timeless(first.summary) == timeless(second.summary)
    rows = list(first.rows())
    assert len({row.score for row in rows}) == 4
    scene = advsearch.load_scene("mug", settings={"pose.yaw": 180.0, "camera.elevation": 60.0})
    render = scene.renderer({"pose": {"yaw": [0, 360]}}, resolution=16)
    with torch.no_grad():
        picture = render(render.start, seed=rows[3].seed or 0, spp=1)
        logits = model()((picture * 255.0).round() / 255.0)
    assert float(logits[0, 1] - logits[0, 0]) == pytest.approx(rows[3].score, abs=0.2)


@pytest.mark.medium
@pytest.mark.parametrize("keep", ["all", "wrong", "none"])
def test_pictures_are_kept_as_asked(tmp_path: Path, keep: Literal["all", "wrong", "none"]) -> None:
    models = [model(0.65, "strict"), model(0.9, "easy")]
    result = advsearch.sweep(
        "mug", models, {"pose.yaw": list(range(0, 360, 45))}, trials=0, run=tmp_path / "run", keep_pictures=keep
    )
    rows = list(result.rows())
    wrong = {row.step // 2 for row in rows if not row.correct}
    assert 0 < len(wrong) < 8
    files = (tmp_path / "run" / "images" / "rows").glob("*/*.jpg")
    assert {int(file.stem) for file in files} == {"all": set(range(8)), "wrong": wrong, "none": set()}[keep]


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    controls = {"pose": {"yaw": [0, 180]}, "light": {"power": [0, 40]}}
    return kept_configuration(tmp_path_factory.mktemp("runs") / "turned", controls, [0.5, 0.25])


@pytest.mark.medium
def test_an_adversarial_scene_has_the_draws_and_the_noise_of_the_clean_scene(attacked: Path, tmp_path: Path) -> None:
    result = advsearch.sweep(
        model=model(), adversarial_of=attacked, grid={"camera.azimuth": [0, 90]}, controls="corruption", samples=3,
        batch=2,
        sampler="random", trials=0, run=tmp_path / "run",
    )  # fmt: skip
    rows = list(result.rows())
    clean, answer = rows[:6], rows[6:]
    assert [row.values["answer"]["value"] for row in rows] == ["clean"] * 6 + ["turned"] * 6
    assert [row.seed for row in clean] == [row.seed for row in answer] and len({row.seed for row in clean}) == 6
    for one, other in zip(clean, answer, strict=True):
        drawn = {name: value for name, value in one.values.items() if name.startswith(("camera.", "corruption."))}
        assert len(drawn) > 1 and drawn == {name: other.values[name] for name in drawn}
        assert not any(name.startswith(("pose", "light")) for name in (*one.values, *other.values)), "these stand still"


class Turned(FakeRenderer):
    """Brighter the further the object is turned."""

    def __call__(self, u: Tensor, seed: int, spp: int) -> Tensor:
        yaw = float(self.space.describe(u)["pose.yaw"]["value"])
        return 0.6 * super().__call__(u, seed, spp) + yaw / 400.0


@pytest.mark.medium
def test_both_rates_stand_side_by_side_with_what_the_pairs_say(
    attacked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(swept_scene, "make_renderer", Turned)
    two = [model(0.5, "one"), model(0.55, "two")]
    result = advsearch.sweep(model=two, adversarial_of=attacked, samples=40, trials=0, run=tmp_path / "run")
    beside, rows = result.summary.arms, list(result.rows())
    assert beside is not None and beside.adversarial_run == "turned"
    assert [pair.model for pair in beside.pairs] == ["one", "two"]
    assert result.summary.controls == ["camera"], "what the attack was over"
    for number, pair in enumerate(beside.pairs):
        right = [bool(row.correct) for row in rows[number::2]]
        pairs = list(zip(right[:40], right[40:], strict=True))
        assert pair.both == pairs.count((True, True)) and pair.neither == pairs.count((False, False))
        assert pair.clean_only == pairs.count((True, False)) and pair.adversarial_only == pairs.count((False, True))
        assert pair.clean.correct == sum(right[:40]) and pair.adversarial.correct == sum(right[40:])
        assert pair.difference == pytest.approx((sum(right[40:]) - sum(right[:40])) / 40)
    assert beside.pairs[0].clean_only > 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FakeRenderer, "stops_at", FakeRenderer.calls + 60)
        stopped = advsearch.sweep(model=two, adversarial_of=attacked, samples=40, trials=0, run=tmp_path / "stopped")
    assert stopped.summary.ending == "interrupted" and stopped.summary.arms is not None
    again = advsearch.sweep(model=two, adversarial_of=attacked, samples=40, trials=0, run=tmp_path / "stopped")
    assert again.summary.arms == beside and rows_of(tmp_path / "stopped") == rows_of(tmp_path / "run")


@pytest.mark.medium
def test_what_is_rendered_with_an_adversarial_scene_is_the_adversarial_scene_really_rendered(attacked: Path) -> None:
    grid = {"camera.azimuth": [20, 110]}
    small: dict[str, Any] = {"resolution": SIZE, "spp": 4, "trials": 0, "denoise": "none"}
    both = advsearch.sweep(model=model(), adversarial_of=attacked, grid=grid, **small)
    margins = [row.margin or 0.0 for row in both.rows()]
    clean, answer = margins[:2], margins[2:]
    turned = advsearch.load_scene("mug", settings={"pose.yaw": 90.0})
    found = advsearch.sweep(turned, model(), {**grid, "light.power": [10.0]}, **small)
    plain = advsearch.sweep("mug", model(), {**grid, "light.power": [0.0]}, **small)
    assert clean == pytest.approx([row.margin for row in plain.rows()], abs=1e-3)
    assert answer == pytest.approx([row.margin for row in found.rows()], abs=1e-3)
    assert abs(clean[0] - answer[0]) > 0.1


CHANGES: dict[str, Any] = {"must_change": "black,covered,away", "must_not_change": "exposure,shift,jpeg"}


@pytest.mark.medium
def test_a_model_that_looks_is_told_from_one_that_does_not_really_rendered(tmp_path: Path) -> None:
    advsearch.allow_code("small_models:blind")
    swept = advsearch.sweep(
        "mug", "reference,small_models:blind", {"pose.yaw": "0:360:12"}, trials=0, resolution=64, run=tmp_path / "run",
        **CHANGES,
    )  # fmt: skip
    rates = {(one.model, one.when): one for one in swept.summary.changes or ()}
    assert len(rates) == 12 and {one.configurations for one in rates.values()} == {12}
    for (name, when), one in rates.items():
        looks = name == "reference" or one.claim == "must_not_change"
        assert (one.correct >= 9) if looks else (one.correct == 0 and one.row == 1), (name, when, one)
    assert sum("may not be looking" in text for text in swept.summary.warnings) == 3
    row = next(iter(swept.rows()))
    assert set(row.metrics) == {f"{claim} {when}" for claim, names in CHANGES.items() for when in names.split(",")}


def test_what_a_row_says_is_true_of_the_picture_that_its_model_was_shown() -> None:
    wide = advsearch.load_model(Brightness(0.55, slope=20.0), labels=LABELS, input_size=(SIZE, 2 * SIZE), name="wide")
    drawn: dict[str, Any] = {"camera": {}}
    both = advsearch.sweep("mug", [model(), wide], controls=drawn, samples=2, trials=0)
    alone = [
        row.values["camera.distance"]
        for one in (model(), wide)
        for row in advsearch.sweep("mug", one, controls=drawn, samples=2, trials=0).rows()
    ]
    found = [row.values["camera.distance"] for row in both.rows()]
    assert [found[0], found[2], found[1], found[3]] == alone and found[0] != found[1]


@pytest.mark.medium
def test_other_settings_do_not_go_on_and_a_finished_sweep_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "run"
    FakeRenderer.stops_at = 10
    advsearch.sweep("mug", model(), run=path, **SURVIVES)
    FakeRenderer.stops_at = None
    with pytest.raises(RunExistsError, match="the run exists already"):
        advsearch.sweep("mug", model(), run=path, **{**SURVIVES, "seed": 1})
    advsearch.sweep("mug", model(), run=path, **SURVIVES)
    with pytest.raises(RunExistsError, match="the run exists already"):
        advsearch.sweep("mug", model(), run=path, **SURVIVES)


@pytest.mark.medium
def test_each_photograph_of_a_folder_is_a_scene_and_a_unit(tmp_path: Path) -> None:
    folder = write_photograph_folder(tmp_path / "desk", set={"ground.size": 0.0})
    box = str(PHOTOGRAPHS / "models" / "obj_000002.ply")
    options: dict[str, Any] = {"resolution": 16, "spp": 1, "trials": 0, "denoise": "none", "label": "mug"}
    scene = advsearch.load_scene(box, backdrop=folder, unit="mm")
    table = advsearch.sweep(scene, "small_models:easy", controls={"pose": {"yaw": [0, 20]}}, samples=2, **options)
    rows = list(table.rows())
    names = [f"{number:06d}.jpg" for number in (1, 3, 5, 7, 9, 11)]
    assert [row.values["backdrop"]["value"] for row in rows] == [name for name in names for _ in range(2)]
    assert [row.value for row in table.summary.axes if row.axis == "backdrop"] == names
    assert table.summary.units == 6 and table.summary.configurations == 12
    drawn = advsearch.sweep(scene, "small_models:easy", controls="backdrop", samples=8, **options)
    assert {row.values["backdrop.which"]["value"] for row in drawn.rows()} <= set(names)
