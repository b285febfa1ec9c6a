"""Recipes: what a file may say, the runs that it comes to, what figures say, and one that is rendered."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import advsearch
from advsearch.cli.main import main
from advsearch.errors import FileFormatError
from advsearch.experiment import run_experiment
from advsearch.questions.attack.summary import FoundValue, SearchDistribution
from advsearch.questions.recipe import carry_out as carrying_out
from advsearch.questions.recipe import recipe as asked
from advsearch.questions.recipe.carry_out import make_figures, read_figure_options
from advsearch.questions.recipe.description import Recipe, list_recipes, plan_runs, read_recipe, titles
from advsearch.questions.recipe.rates import ClusteredFraction, FigureContent, Rows, make_frame
from advsearch.questions.recipe.result import RecipeConfig, RecipeResult
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.runs.summary import read_result
from advsearch.statistics.intervals import clopper_pearson

pytestmark = pytest.mark.island("advsearch.questions.recipe")

TINY = """
title: Is the mug seen?
settings: {object: [mug, bowl], environment: [studio, noon], resolution: 16, spp: 1}
parts:
  views:
    command: sweep
    settings: {controls: {camera: {}}, samples: 2, sampler: random, trials: 0}
figures:
  - {figure: rates, form: map, by: object, series: environment}
  - {figure: rates, by: environment}
"""


@dataclass(frozen=True)
class Answered:
    """A row: what it shows, with units, and what was said of it."""

    part: str
    values: dict[str, Any]
    units: dict[str, str]
    answer: str
    correct: bool
    time: float | None = None
    margin: float | None = None
    unit: str | None = None


def tabled(given: Sequence[Answered], groups: dict[str, list[str]] | None = None, **more: Any) -> Rows:
    """Rows as the frame of a recipe."""
    said = ("part", "answer", "correct", "time", "margin")
    listed = [
        {"model": "m", **one.values, **{name: getattr(one, name) for name in said}, "unit": one.unit or f"row {n}"}
        for n, one in enumerate(given)
    ]
    units = {name: unit for one in given for name, unit in one.units.items()}
    return make_frame(listed, groups or {}, units=units, **{"cores": 1, "surfaces": {}, **more})


def rows(counts: dict[str, tuple[int, int]], **more: float | str) -> list[Answered]:
    """Rows with so many right of so many for each environment."""
    return [
        answered({"environment": name, "object": "mug", **more}, number < right)
        for name, (right, of) in counts.items()
        for number in range(of)
    ]


def answered(values: dict[str, float | str], right: bool) -> Answered:
    """A row: a mug, or a mug that is taken for a cup."""
    return Answered("views", values, {}, "mug" if right else "cup", right)


def figure(
    described: dict[str, object], answered: Sequence[Answered], groups: dict[str, list[str]] | None = None
) -> FigureContent:
    """The only figure of these rows."""
    (made,) = make_figures(tabled(answered, groups), *read_figure_options(described, "here"))
    return made


def counts(made: FigureContent) -> dict[Any, tuple[Any, Any]]:
    """What is counted, of how many, by the names before it."""
    names = made.columns.index("of") - 1
    return {row[0] if names == 1 else tuple(row[:names]): (row[names], row[names + 1]) for row in made.rows}


@pytest.mark.parametrize("name", list_recipes())
@pytest.mark.parametrize("quick", [False, True])
def test_every_bundled_recipe_is_one_that_can_be_run_and_save(name: str, quick: bool) -> None:
    described = read_recipe(name)
    runs = plan_runs(described, RecipeConfig(recipe=name, quick=quick))
    assert runs and len({one.name for one in runs}) == len(runs)
    drawn = [one.config.seed for one in runs if described.parts[one.part_name].drawn_as is None]
    assert len(set(drawn)) == len(drawn) and set(drawn) == {one.config.seed for one in runs}
    assert described.figures and all(read_figure_options(one, name) for one in described.figures)
    assert titles()[name] == described.title and described.title.endswith("?")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("title: a\nparts: {a: {command: doctor}}", "parts.a.command"),
        ("title: a\nparts: {a: {command: sweep, settings: {run: /x}}}", "'run'"),
        ("title: a\nparts: {../a: {command: sweep}}", "expected names"),
        ("title: a\nparts: {a: {command: sweep, around: b}}", "around"),
        ("title: a\nparts: {a: {command: sweep, shell: rm}}", "parts.a.shell"),
        ("title: !!python/object:os.system a\nparts: {}", "expected YAML"),
    ],
)
def test_a_hostile_recipe_is_refused_in_one_sentence(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(FileFormatError) as error:
        read_recipe(str(path))
    assert message in str(error.value) and str(error.value).isprintable() and len(str(error.value)) < 500


def test_python_code_in_a_file_is_not_imported_unasked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(TINY.replace("spp: 1", "spp: 1, model: 'os.path:join'"))
    assert main(["recipe", str(path), "--run", str(tmp_path / "run")]) == 2
    assert "os.path:join, Python code" in capsys.readouterr().err
    assert not (tmp_path / "run" / "summary.json").exists()


def test_what_is_asked_for_goes_over_the_recipe_and_labels_go_to_their_objects() -> None:
    parts = {"a": {"command": "sweep", "settings": {"environment": "noon"}}, "b": {"command": "attack"}}
    described = Recipe(title="a", settings={"object": "mug", "environment": "studio"}, parts=parts)
    config = RecipeConfig(
        recipe="mine", object="x/mug.obj,bowl", environment="kitchen,loft", model="m.pt2",
        label={"mug": "coffee mug,cup", "*": "bowl"}, seed=3,
    )  # fmt: skip
    runs = plan_runs(described, config)
    assert [(one.part_name, one.config.object, one.config.environment, one.config.label) for one in runs] == [
        ("a", "x/mug.obj", "noon", "coffee mug,cup"),
        ("a", "bowl", "noon", "bowl"),
        *(("b", name, place, label) for name, label in (("x/mug.obj", "coffee mug,cup"), ("bowl", "bowl"))
          for place in ("kitchen", "loft")),
    ]  # fmt: skip
    assert runs[0].name == "a-00-mug" and runs[2].name == "b-00-mug-kitchen"
    assert all(one.config.model == "m.pt2" for one in runs)


@pytest.mark.medium
def test_a_recipe_is_carried_out_and_goes_on_where_it_was_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, run = tmp_path / "mine.yaml", tmp_path / "run"
    path.write_text(TINY)
    real, done = run_experiment, list[str]()

    def stopping(config: Any, **named: Any) -> Any:
        if config.object == "bowl" and not done.count("bowl"):
            done.append("bowl")
            raise KeyboardInterrupt
        done.append(config.object)
        return real(config, **named)

    monkeypatch.setattr("advsearch.experiment.run_experiment", stopping)
    with pytest.raises(KeyboardInterrupt):
        advsearch.recipe(path, run=run)
    path.unlink()  # it goes on as it began
    result = asked.run(RecipeConfig.from_yaml(run / "run.yaml"), resumed_directory=run)
    assert done == ["mug", "bowl", "bowl"]
    assert result.to_dict() == read_result(run).to_dict() and isinstance(read_result(run), RecipeResult)
    assert [one.renders for one in result.parts] == [4, 4] and result.ending == "done"
    pairs, bars = result.figures
    counts: Any = bars.rows
    assert [row[3] for row in pairs.rows] == [2, 2, 2, 2, 4, 4] and pairs.columns[:4] == [
        "object", "environment", "right", "of",
    ]  # fmt: skip
    assert sum(row[2] for row in counts) == 8


def test_what_is_drawn_has_the_mean_and_the_deviation_that_a_search_answers_with() -> None:
    searched = {
        "camera.elevation": {"value": 30.0, "unit": "degrees", "low": 0.0, "high": 80.0},
        "camera.azimuth": {"value": 350.0, "unit": "degrees", "low": 0.0, "high": 360.0},
        "camera.roll": {"value": 0.0, "unit": "degrees", "low": -30.0, "high": 30.0},
        "camera.distance": {"value": 2.0, "unit": "object sizes", "low": 1.0, "high": 4.0},
    }
    found = SearchDistribution.from_values({"mean": searched, "deviation": [0.1, 0.05, 2.0, 0.1]})
    ranges = {name: FoundValue.from_values(value) for name, value in searched.items()}
    drawn = carrying_out.sample_around(SweepConfig(object="mug"), found, ranges)
    assert isinstance(drawn, SweepConfig) and drawn.sampler == "random"
    camera: Any = drawn.controls["camera"]
    low, high = camera["elevation"]
    assert ((low + high) / 2, (high - low) / 12**0.5) == pytest.approx((30.0, 8.0))
    assert camera["azimuth"][1] > 360.0 and sum(camera["azimuth"]) / 2 == pytest.approx(350.0)
    assert camera["roll"] == pytest.approx([-30.0, 30.0])
    low, high = np.log2(camera["distance"])  # evenly along the logarithm, as it is searched
    assert ((low + high) / 2, (high - low) / 12**0.5) == pytest.approx((1.0, 0.2))


def test_intervals_are_over_drives_where_frames_of_one_share_a_draw() -> None:
    frames = [replace(row, unit=f"drive {n // 10}") for n, row in enumerate(rows({"noon": (40, 100)}))]
    alone, together = (
        ClusteredFraction.from_rows("noon", tabled(some)) for some in (rows({"noon": (40, 100)}), frames)
    )
    own, others = alone.interval(), together.interval()
    assert (
        own is not None and others is not None and alone.table_cells[:3] == together.table_cells[:3] == [40, 100, 0.4]
    )
    assert own == clopper_pearson(40, 100) and others[0] < own[0] and others[1] > own[1]
    (row,) = figure({"figure": "rates", "by": "environment"}, frames).rows
    assert row == ["noon", *together.table_cells]


def test_shape_and_texture_are_told_apart() -> None:
    """A model that answers by shape, one that answers by texture, and one that answers by neither."""
    pairs = [(shape, texture) for shape in ("mug", "bowl", "vase") for texture in ("zebra", "brick") for _ in range(20)]
    said = {
        "more by shape than by texture": [shape for shape, _ in pairs],
        "more by texture than by shape": [texture for _, texture in pairs],
        "no difference is shown": ["cup"] * len(pairs),
    }
    for text, answers in said.items():
        answered = [
            Answered("a", {"object": shape, "material.which": texture}, {}, answer, shape == answer)
            for (shape, texture), answer in zip(pairs, answers, strict=True)
        ]
        made = figure({"figure": "cues", "classes": {"zebra": ["zebra"]}}, answered)
        assert any(text in one for one in made.text)
        assert any(row[-1] for row in made.rows) == (answers[0] == "zebra")


def test_photographs_agree_with_the_renderings_whose_configurations_they_show() -> None:
    made = figure(
        {"figure": "agreement", "of": ["renderings", "again"], "names": {"again": "through a sensor"}}, PICTURED
    )
    of_all = {row[0]: row[2:] for row in made.rows if row[1] == "all objects"}
    assert of_all["photographs"][:7] == [5, 1, 0, 2, 7, 7, 8] and of_all["through a sensor"][5] == 10
    assert of_all["photographs"][8:] == [*clopper_pearson(7, 8)]
    assert "right about both or wrong about both in 7 of 8 (88 %, 95 % interval 47-99.7 %)" in made.text[0]
    assert "it is right in 5 of 6" in made.text[0] and "wrong in 2 of 2" in made.text[0]
    assert made.text[2].startswith("1 of the photographs belongs to no rendering")


def test_the_mean_corruption_error_is_relative_to_the_first_model() -> None:
    errors = {"one": {"fog": 4, "jpeg": 2}, "two": {"fog": 8, "jpeg": 1}}
    answered = [
        Answered("corrupted", {"object": "mug", "model": model, "corruption.which": which}, {}, "mug", number >= wrong)
        for model, wrongs in errors.items()
        for which, wrong in wrongs.items()
        for number in range(10)
    ]
    clean = [Answered("clean", {"object": "mug", "model": model}, {}, "mug", True) for model in errors] * 9
    asked = {"figure": "rates", "by": "corruption.which", "series": "model", "wrong": True, "beside": "clean"}
    made = figure(asked, [*answered, *clean])
    assert counts(made) == {
        ("clean", "one"): (0, 9), ("clean", "two"): (0, 9), ("jpeg", "one"): (2, 10), ("jpeg", "two"): (1, 10),
        ("fog", "one"): (4, 10), ("fog", "two"): (8, 10), ("all", "one"): (6, 20), ("all", "two"): (9, 20),
    }  # fmt: skip
    relative = (8 / 4 + 1 / 2) / 2 * 100
    assert f"Relative to one, in AlexNet's place, the mCE of two is {relative:.0f} %." in made.text
    assert any(text.startswith("two, clean: wrong in 0 of 9") and text.endswith("is not shown.") for text in made.text)


PICTURED = [
    Answered(part, {"object": "mug", "model": "m", **values}, {}, "mug" if right else "cup", right)
    for part, values, right in [
        *(("renderings", {"yaw": float(at)}, at < 6) for at in range(10)),
        *(("again", {"yaw": float(at), "sensor.shot": 0.1}, at < 6) for at in range(10)),
        *(("photographs", {"yaw": float(at)}, at < 5) for at in range(8)),
        ("photographs", {}, True),
    ]
]
"""Ten renderings, the same ones through a sensor, photographs of eight of them, and one of none."""


@pytest.mark.medium
def test_frames_of_a_drive_count_as_one_draw(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("""
title: Is the mug seen on the way?
settings: {object: mug, resolution: 16, spp: 1}
parts:
  drives:
    command: sweep
    settings: {path: approach, fps: 1, controls: {light: {}}, samples: 3, sampler: random, trials: 0}
figures: [{figure: rates, by: object}]
""")
    result = advsearch.recipe(path, run=tmp_path / "run")
    rows: Any = result.figures[0].rows
    ((name, right, of, _, low, high),) = rows
    assert name == "mug" and of > 3 and of % 3 == 0
    alone = clopper_pearson(int(right), int(of))
    assert high - low > alone[1] - alone[0]


def test_a_difference_is_claimed_where_intervals_are_apart_and_not_where_they_overlap() -> None:
    shown = figure(
        {"figure": "rates", "by": "environment"}, rows({"noon": (5, 50), "studio": (45, 50), "loft": (30, 50)})
    )
    assert shown.text[0].startswith(
        "Lowest is noon: right in 5 of 50 (10 %, 95 % interval 3.3-22 %); highest is studio"
    )
    assert shown.text[1].startswith("The difference is shown")
    assert list(counts(shown)) == ["studio", "loft", "noon"]
    hidden = figure({"figure": "rates", "by": "environment"}, rows({"noon": (8, 20), "studio": (12, 20)}))
    assert hidden.text[1].startswith("No difference between the environments is shown")
    same = figure({"figure": "rates", "by": "environment"}, rows({"noon": (8, 20), "studio": (8, 20)}))
    assert same.text == ["All 2 environments have the same share, 40 %: no difference is shown."]
