"""Recipes: what a file may say, the runs that it comes to, what figures say, and one that is rendered."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import advsearch
from advsearch.attacks import make_policy
from advsearch.cli.main import main
from advsearch.engine.surface_light import find_surface_light_refusal
from advsearch.errors import AdvsearchError, FileFormatError, InputError, UnknownNameError
from advsearch.experiment import run_experiment
from advsearch.questions.attack.carry_out import load_parts, make_problem_with_warnings
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.summary import FoundValue, SearchDistribution
from advsearch.questions.recipe import carry_out as carrying_out
from advsearch.questions.recipe import recipe as asked
from advsearch.questions.recipe.carry_out import FIGURES, check_figures, draw_files, make_figures, read_figure_options
from advsearch.questions.recipe.description import Recipe, list_recipes, plan_runs, read_recipe, titles
from advsearch.questions.recipe.given import CuesOptions, count_predicted, find_triangle, list_triangles, shorten_to_fit
from advsearch.questions.recipe.rates import ClusteredFraction, FigureContent, Rows, make_frame
from advsearch.questions.recipe.result import RecipeConfig, RecipeFigure, RecipeResult, omit_repeated_sentences
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.summary import SurfaceMap
from advsearch.runs.files import write_png
from advsearch.runs.summary import read_result
from advsearch.statistics.intervals import clopper_pearson

SCENES = Path(__file__).resolve().parents[2] / "advsearch/bundled/data/environments"

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


def answer(described: dict[str, object], answered: Sequence[Answered]) -> RecipeFigure:
    """The only figure of these rows, as a result has it."""
    made = figure(described, answered)
    return RecipeFigure(figure="rates", title=made.title, text=list(made.text), columns=[], rows=[])


def counts(made: FigureContent) -> dict[Any, tuple[Any, Any]]:
    """What is counted, of how many, by the names before it."""
    names = made.columns.index("of") - 1
    return {row[0] if names == 1 else tuple(row[:names]): (row[names], row[names + 1]) for row in made.rows}


EXAMPLES: dict[str, dict[str, object]] = {
    "bars": {"figure": "rates", "by": "group"},
    "bars side by side": {"figure": "rates", "by": "object", "series": "environment", "names": {"noon": "at noon"}},
    "lines": {"figure": "rates", "form": "lines", "by": "yaw", "series": "environment", "bins": 3},
    "map": {"figure": "rates", "form": "map", "by": "object", "series": "environment"},
    "errors": {"figure": "rates", "by": "environment", "series": "model", "wrong": True},
    "answers": {"figure": "answers", "by": "environment"},
    "cues": {"figure": "cues", "texture": "environment", "classes": {"noon": ["cup"]}},
    "ternary": {"figure": "ternary", "shares": ["water", "milk", "coffee"], "normalised": True},
    "surface": {"figure": "surface"},
    "scaling": {"figure": "scaling"},
    "agreement": {"figure": "agreement", "of": ["renderings", "again"], "names": {"again": "through a sensor"}},
}


# ---- what a file may say --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list_recipes())
@pytest.mark.parametrize("quick", [False, True])
def test_every_bundled_recipe_is_one_that_can_be_run_and_save(name: str, quick: bool) -> None:
    described = read_recipe(name)
    runs = plan_runs(described, RecipeConfig(recipe=name, quick=quick))
    assert runs and len({one.name for one in runs}) == len(runs)
    drawn = [one.config.seed for one in runs if described.parts[one.part].drawn_as is None]
    assert len(set(drawn)) == len(drawn) and set(drawn) == {one.config.seed for one in runs}
    assert described.figures and all(read_figure_options(one, name) for one in described.figures)
    assert titles()[name] == described.title and described.title.endswith("?")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("title: a", "parts: Field required"),
        ("title: a\nparts: {a: {command: doctor}}", "parts.a.command: Input should be 'attack' or 'sweep'"),
        ("title: a\nparts: {a: {command: sweep, settings: {run: /x}}}", "'run' is the same for all parts"),
        ("title: a\nparts: {../a: {command: sweep}}", "expected names of small letters, digits and hyphens"),
        ("title: a\nparts: {a: {command: sweep}}\nsettings: {overwrite: true}", "'overwrite' is said with the command"),
        ("title: a\nparts: {a: {command: sweep, around: b}}", "around: expected a part before it, got 'b'"),
        ("title: a\nparts: {photographs: {command: sweep}}", "expected another name than 'photographs'"),
        ("title: a\nparts: {a: {command: sweep, drawn_as: a}}", "drawn_as: expected a part before it, got 'a'"),
        ("title: a\nparts: {a: {command: sweep, shell: rm}}", "parts.a.shell: Extra inputs are not permitted"),
        ("title: !!python/object:os.system a\nparts: {}", "expected YAML"),
        ("- a", "expected settings and values"),
    ],
)
def test_a_hostile_recipe_is_refused_in_one_sentence(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(FileFormatError) as error:
        read_recipe(str(path))
    assert message in str(error.value) and str(error.value).isprintable() and len(str(error.value)) < 500


@pytest.mark.medium
@pytest.mark.parametrize(
    ("change", "kind", "message"),
    [
        ({"parts": {"a": {"command": "sweep", "settings": {"stesp": 4}}}}, UnknownNameError, "unknown setting 'stesp'"),
        (
            {"parts": {"a": {"command": "sweep", "settings": {"samples": "many"}}}},
            InputError,
            "mine: parts: a: samples: expected a whole number",
        ),
        ({"settings": {}}, InputError, "object: expected one, since mine names none"),
        ({"settings": {"object": ["mug"] * 1001}}, InputError, "expected at most 1000 runs, got 1001"),
        ({"quick": {"parts": {"b": {}}}}, UnknownNameError, "unknown part 'b'"),
    ],
)
def test_what_no_command_takes_is_refused_before_anything_is_done(
    change: dict[str, Any], kind: type[AdvsearchError], message: str
) -> None:
    described = {"title": "a", "settings": {"object": "mug"}, "parts": {"a": {"command": "sweep"}}, **change}
    with pytest.raises(kind, match=message):
        plan_runs(Recipe(**described), RecipeConfig(recipe="mine", quick=True))


@pytest.mark.parametrize(
    ("described", "kind", "message"),
    [
        ({"figure": "pie"}, UnknownNameError, "unknown figure 'pie'"),
        ({"figure": "rates"}, FileFormatError, "figures: rates: by: Field required"),
        (
            {"figure": "rates", "by": "weather"},
            InputError,
            "figures: expected one of model, environment, object, part, answer, got",
        ),
    ],
)
def test_a_figure_that_cannot_be_made_is_refused(
    described: dict[str, object], kind: type[AdvsearchError], message: str
) -> None:
    with pytest.raises(kind, match=message):
        figure(described, rows({"noon": (1, 2)}))


@pytest.mark.medium
def test_the_sweeps_of_a_recipe_are_explained(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(TINY)
    assert main(["recipe", str(path), "--run", str(tmp_path / "run"), "--quiet"]) == 0
    with pytest.raises(InputError, match="expected at least 100 rows, got 8; sweep more"):
        advsearch.explain(tmp_path / "run")


@pytest.mark.medium
@pytest.mark.parametrize(
    ("further", "message"),
    [
        (["--object", "mug,nosuch"], "unknown object 'nosuch'"),
        (["--object", "mug,bowl", "--label", "bowl=unicorn"], "unicorn"),
        (["--environment", "studio,nowhere"], "unknown environment 'nowhere'"),
    ],
)
def test_a_later_object_is_checked_before_anything_is_rendered(
    further: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(TINY)
    assert main(["recipe", str(path), *further, "--run", str(tmp_path / "run")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.medium
@pytest.mark.parametrize(
    ("figure", "message"),
    [
        (
            "{figure: rates, by: camera.elevatoin}",
            "unknown column 'camera.elevatoin'. Did you mean 'camera.elevation'",
        ),
        ("{figure: rates, by: object, series: trial}", "unknown column 'trial'"),
        ("{figure: rates, by: object, of: [vievs]}", "unknown part 'vievs'. Did you mean 'views'?"),
    ],
)
def test_a_figure_of_what_no_row_will_have_is_refused_before_anything_is_rendered(
    figure: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(f"{TINY}  - {figure}\n")
    assert main(["recipe", str(path), "--run", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert message in said and f"It stands in {path}, figure 3 ({figure[9:].split(',')[0]}), as `" in said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", list_recipes())
def test_the_figures_of_every_bundled_recipe_name_columns_that_there_are(name: str) -> None:
    described, config = read_recipe(name), RecipeConfig(recipe=name, quick=True, object="mug")
    check_figures(described, carrying_out.check_runs(plan_runs(described, config)), name)


@pytest.mark.medium
@pytest.mark.parametrize("name", list_recipes())
def test_every_bundled_recipe_takes_an_environment_of_ones_own(tmp_path: Path, name: str) -> None:
    room = tmp_path / "room.exr"
    room.write_bytes((SCENES / "loft.exr").read_bytes())
    runs = plan_runs(read_recipe(name), RecipeConfig(recipe=name, quick=True, object="mug", environment=str(room)))
    assert runs and carrying_out.check_runs(runs).keys() == {one.part for one in runs}


@pytest.mark.parametrize("name", list_recipes())
def test_every_bundled_recipe_takes_a_detector_or_says_why_not(name: str) -> None:
    described = read_recipe(name)
    config = RecipeConfig(recipe=name, object="mug", task="detection={overlap: 0.4}", label="cup")
    runs = plan_runs(described, config)
    assert runs and all(one.config.task == {"name": "detection", "overlap": 0.4} for one in runs)
    if name != "texture-shape":
        carrying_out.check_recipe(described, config)
        return
    with pytest.raises(InputError, match="task: texture-shape asks whether predictions are classes of the texture"):
        carrying_out.check_recipe(described, config)


def test_the_recipe_for_viewpoints_searches_predicted_pictures_and_counts_rendered_ones() -> None:
    runs = {
        one.part: one.config
        for one in plan_runs(read_recipe("viewpoints"), RecipeConfig(recipe="viewpoints", object="mug"))
    }
    search, drawn = runs["search"], [runs["all"], runs["worst"]]
    assert isinstance(search, AttackConfig) and search.steps is not None
    problem, _ = make_problem_with_warnings(load_parts(search))
    assert find_surface_light_refusal(problem, search.steps, make_policy(search.policy_name), search.specialise) is None
    assert [isinstance(one, SweepConfig) and one.specialise for one in drawn] == [False, False]


def test_python_code_in_a_file_is_not_imported_unasked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(TINY.replace("spp: 1", "spp: 1, model: 'os.path:join'"))
    assert main(["recipe", str(path), "--run", str(tmp_path / "run")]) == 2
    assert "os.path:join, Python code" in capsys.readouterr().err
    assert not (tmp_path / "run" / "summary.json").exists()


# ---- the runs -------------------------------------------------------------------------------------------------------


def test_what_is_asked_for_goes_over_the_recipe_and_labels_go_to_their_objects() -> None:
    parts = {"a": {"command": "sweep", "settings": {"environment": "noon"}}, "b": {"command": "attack"}}
    described = Recipe(title="a", settings={"object": "mug", "environment": "studio"}, parts=parts)
    config = RecipeConfig(
        recipe="mine", object="x/mug.obj,bowl", environment="kitchen,loft", model="m.pt2",
        label={"mug": "coffee mug,cup", "*": "bowl"}, seed=3,
    )  # fmt: skip
    runs = plan_runs(described, config)
    assert [(one.part, one.config.object, one.config.environment, one.config.label) for one in runs] == [
        ("a", "x/mug.obj", "noon", "coffee mug,cup"),
        ("a", "bowl", "noon", "bowl"),
        *(("b", name, place, label) for name, label in (("x/mug.obj", "coffee mug,cup"), ("bowl", "bowl"))
          for place in ("kitchen", "loft")),
    ]  # fmt: skip
    assert runs[0].name == "a-00-mug" and runs[2].name == "b-00-mug-kitchen"
    assert all(one.config.model == "m.pt2" for one in runs)


@pytest.mark.medium
def test_a_recipe_is_carried_out_and_goes_on_where_it_was_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
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
    result = asked.run(RecipeConfig.from_yaml(run / "run.yaml"), resumed=run)
    assert done == ["mug", "bowl", "bowl"]
    assert result.to_dict() == read_result(run).to_dict() and isinstance(read_result(run), RecipeResult)
    assert [one.renders for one in result.parts] == [4, 4] and result.ending == "done"
    pairs, bars = result.figures
    counts: Any = bars.rows
    assert [row[3] for row in pairs.rows] == [2, 2, 2, 2, 4, 4] and pairs.columns[:4] == [
        "object", "environment", "right", "of",
    ]  # fmt: skip
    assert sum(row[2] for row in counts) == 8
    page = (run / "report.html").read_text()
    assert all(text in page.replace("&nbsp;", " ") for text in (result.title, *pairs.text, *bars.text))
    assert page.count("data:image/png") == 2 and {"figure-1.png", "figure-2.svg"} <= {
        one.name for one in (run / "images").iterdir()
    }
    assert main(["show", str(run), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["figures"][1]["columns"][0] == "environment"


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


@pytest.mark.medium
def test_photographs_come_from_a_folder_and_their_figure_is_made_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, run, folder = tmp_path / "mine.yaml", tmp_path / "run", tmp_path / "photographs"
    controls = "controls: {camera: {}}, samples: 2, sampler: random, trials: 0, keep_pictures: all"
    path.write_text(f"""
title: Is the mug seen?
settings: {{object: mug, resolution: 16, spp: 1}}
parts:
  renderings: {{command: sweep, settings: {{{controls}}}}}
  finer: {{command: sweep, drawn_as: renderings, settings: {{{controls}, spp: 2}}}}
figures: [{{figure: agreement, of: [renderings, finer]}}]
""")
    with pytest.raises(InputError, match="photographs: expected a folder"):
        advsearch.recipe(path, run=run, photographs=folder)
    (folder / "mug").mkdir(parents=True)
    advsearch.recipe(path, run=run)
    assert main(["resume", str(run), f"photographs={folder}"]) == 2
    assert "expected some in a folder for each object (mug)" in capsys.readouterr().err
    for name in ("rendering-1", "rendering-1-again", "any"):
        write_png(folder / "mug" / f"{name}.png", np.full((20, 30, 3), 0.5))
    with pytest.raises(InputError, match=r"any\.png: the task asks where the object is"):  # before anything is rendered
        advsearch.recipe(path, run=tmp_path / "found", photographs=folder, task="detection")
    assert not (tmp_path / "found").exists()
    for _ in range(2):  # those that it has are not taken again
        assert main(["resume", str(run), f"photographs={folder}", "--json"]) == 0
        printed = json.loads(capsys.readouterr().out)
        (agreement,) = (RecipeFigure.of(one) for one in printed["figures"])
        of = agreement.columns.index("of")
        assert {(row[0], row[1]): row[of] for row in agreement.rows} == {
            (part, name): 2 for part in ("photographs", "finer") for name in ("all objects", "mug")
        }
        assert "1 of the photographs belongs to no rendering and so to no pair." in agreement.text
    write_png(folder / "mug" / "rendering-9.png", np.full((20, 30, 3), 0.5))
    assert main(["resume", str(run), f"photographs={folder}"]) == 2
    assert "rendering-9.png: rendering: " in capsys.readouterr().err


def test_what_is_drawn_has_the_mean_and_the_deviation_that_a_search_answers_with() -> None:
    searched = {
        "camera.elevation": {"value": 30.0, "unit": "degrees", "low": 0.0, "high": 80.0},
        "camera.azimuth": {"value": 350.0, "unit": "degrees", "low": 0.0, "high": 360.0},
        "camera.roll": {"value": 0.0, "unit": "degrees", "low": -30.0, "high": 30.0},
        "camera.distance": {"value": 2.0, "unit": "object sizes", "low": 1.0, "high": 4.0},
    }
    found = SearchDistribution.of({"mean": searched, "deviation": [0.1, 0.05, 2.0, 0.1]})
    ranges = {name: FoundValue.of(value) for name, value in searched.items()}
    drawn = carrying_out.sample_around(SweepConfig(object="mug"), found, ranges)
    assert isinstance(drawn, SweepConfig) and drawn.sampler == "random"
    camera: Any = drawn.controls["camera"]
    low, high = camera["elevation"]
    assert ((low + high) / 2, (high - low) / 12**0.5) == pytest.approx((30.0, 8.0))
    assert camera["azimuth"][1] > 360.0 and sum(camera["azimuth"]) / 2 == pytest.approx(350.0)
    assert camera["roll"] == pytest.approx([-30.0, 30.0])
    low, high = np.log2(camera["distance"])  # evenly along the logarithm, as it is searched
    assert ((low + high) / 2, (high - low) / 12**0.5) == pytest.approx((1.0, 0.2))


# ---- what figures say -----------------------------------------------------------------------------------------------


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


def test_sentences_call_values_what_they_are() -> None:
    """Numbers by their parameter, named things by what they are, and lines by the names that a recipe gives."""
    fogs = [
        answered({"object": "mug", "fog.which": kind, "fog.severity": level, "yaw": level, "trial": kind}, right)
        for kind, level, right in [
            ("thin", 1.0, True),
            ("thin", 2.0, True),
            ("thick", 1.0, True),
            ("thick", 2.0, False),
        ]
    ]
    pairs = figure({"figure": "rates", "form": "map", "by": "fog.which", "series": "fog.severity"}, fogs)
    assert pairs.text[0].startswith("The lowest pair is thick with severity 2: right in 0 of 1")
    assert pairs.text[1].startswith("No difference between the pairs of fogs and values of fog.severity is shown")
    names = {"thin": "the object as it is", "thick": "the object in fog"}
    asked = {"figure": "rates", "form": "lines", "by": "yaw", "series": "trial", "bins": 2, "names": names}
    lines = figure(asked, fogs)
    assert lines.text[1].startswith("For the object in fog, lowest where yaw is")
    assert any("No difference between the kinds of trials is shown" in text for text in lines.text)


def test_two_of_many_have_to_be_further_apart_than_two_of_two() -> None:
    two = {"noon": (6, 20), "studio": (18, 20)}
    many = {**two, **{f"room {number}": (14, 20) for number in range(18)}}
    pair, several = (figure({"figure": "rates", "by": "environment"}, rows(one)).text[1] for one in (two, many))
    assert pair.startswith("The difference is shown") and several.startswith("No difference")


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


def told_by(answer: Any, shapes: int, textures: int, seed: int) -> str:
    """Which cue the figure names, of a model that answers by a function of shape, texture and chance."""
    generator = np.random.default_rng(seed)
    answered = [
        Answered("a", {"object": f"s{s}", "material.which": f"t{t}"}, {}, str(answer(s, t, generator)), False)
        for s in range(shapes)
        for t in range(textures)
        for _ in range(8)
    ]
    made = figure({"figure": "cues"}, answered)
    assert sum(given for given, _, _ in count_predicted(tabled(answered), CuesOptions())) == len(answered)
    (text,) = [one for one in made.text if "most frequent prediction about the same object" in one]
    return next(
        kind for kind in ("by shape than by texture", "by texture than by shape", "no difference") if kind in text
    )


@pytest.mark.medium
@pytest.mark.parametrize(("shapes", "textures"), [(2, 13), (13, 2), (6, 13)])
def test_many_textures_of_few_objects_favour_neither_cue(shapes: int, textures: int) -> None:
    """Models that answer by one cue in 6 of 10 pictures and else by chance, and models that answer by chance alone."""
    by_shape = lambda s, t, g: s if g.random() < 0.6 else g.integers(5)  # noqa: E731
    by_texture = lambda s, t, g: t if g.random() < 0.6 else g.integers(5)  # noqa: E731
    assert {told_by(by_shape, shapes, textures, seed) for seed in range(5)} == {"by shape than by texture"}
    assert {told_by(by_texture, shapes, textures, seed) for seed in range(5)} == {"by texture than by shape"}
    at_chance = [
        told_by(lambda s, t, g: min(g.geometric(0.4), 6), shapes, textures, seed) == "no difference"
        for seed in range(40)
    ]
    assert sum(at_chance) >= 34  # 95 % intervals: 38 of 40 on average


def test_one_object_does_not_tell_shape_from_texture() -> None:
    answered = [Answered("a", {"object": "mug", "material.which": t}, {}, "mug", True) for t in ("own", "zebra")]
    made = figure({"figure": "cues"}, answered)
    assert any("takes at least two objects and two textures" in one for one in made.text)


def test_a_mixture_lies_in_its_triangle() -> None:
    for side in (1, 3, 5):
        corners = list_triangles(side)
        assert len(corners) == side * side
        for mixture in [*np.random.default_rng(0).dirichlet((1.0, 1.0, 1.0), 200), *np.eye(3)]:
            three = np.array(corners[find_triangle(mixture, side)])
            weights = np.linalg.solve(three.T, mixture)
            assert weights.min() > -1e-9 and weights.sum() == pytest.approx(1.0)


def test_a_prediction_is_counted_by_what_most_of_a_mixture_is() -> None:
    """An answer that is given where most is milk, and nowhere else."""
    shares = [(a / 9, b / 9, (9 - a - b) / 9) for a in range(10) for b in range(10 - a)]
    answered = [
        Answered("a", {"object": "mug", "w": w, "m": m, "c": c}, {}, "bowl" if m > 0.5 else "mug", m <= 0.5)
        for w, m, c in shares
    ]
    made = figure({"figure": "ternary", "shares": ["w", "m", "c"], "side": 3}, answered)
    counted = {one[1]: one[2] for one in made.rows if one[0] == "bowl"}
    assert counted == {"w": 0, "m": 15, "c": 0} and sum(int(one[3] or 0) for one in made.rows) == 2 * len(shares)
    assert not any("things" in text for text in made.text)


def test_where_a_mixture_has_one_prediction_it_is_shown_how_far_that_leads() -> None:
    """A lead of 1 where most is milk and of 5 elsewhere, a little more or less; no picture with much coffee."""
    shares = [(a / 20, b / 20, (20 - a - b) / 20) for a in range(21) for b in range(21 - a) if a + b > 7]
    answered = [
        Answered(
            "a", {"object": "mug", "w": w, "m": m, "c": c}, {}, "mug", True, 0.0, (1.0 if m > 0.5 else 5.0) + c / 9
        )
        for w, m, c in shares
    ]
    made = figure({"figure": "ternary", "shares": ["w", "m", "c"], "side": 4}, answered)
    leads = {name: mean for name, _, mean, _ in made.rows}
    assert list(leads) == ["w", "m", "c"] and leads["m"] < 2.5 < 4.0 < leads["w"]  # type: ignore[operator]
    assert (
        made.text[0].startswith("The prediction is mug in every picture, so that shares")
        and "most of the mixture is m: 2." in made.text[1]
    )
    assert "The difference is shown" in made.text[1]
    assert made.text[2] == "No picture was drawn in 1 of 16 parts of the diagram, which are hatched."
    assert draw_files(made)["png"]
    same = figure({"figure": "ternary", "shares": ["w", "m", "c"]}, [replace(one, margin=3.0) for one in answered])
    assert "No difference is shown" in same.text[1]
    unknown = figure({"figure": "ternary", "shares": ["w", "m", "c"]}, [replace(one, margin=None) for one in answered])
    assert unknown.text[0] == (
        "mug, 100 % of all predictions, is given as often whatever most of the mixture is: no difference is shown."
    )


def test_two_figures_that_say_the_same_say_it_once() -> None:
    one, two = (answer({"figure": "rates", "by": "environment"}, rows({"noon": (at, 20)})) for at in (8, 9))
    same = ["It says the same as the figure before it."]
    before = ["It says what figures before it say."]
    assert (
        omit_repeated_sentences([one, one, two, one]) == [one.text, same, two.text, before]
        and omit_repeated_sentences([]) == []
    )


def test_curves_along_two_parameters_say_once_what_holds_for_both() -> None:
    answered_ = [
        answered({"object": "ball" if n % 2 else "mug", "yaw": float(n % 7), "zoom": float(n % 5)}, n % 4 == 0)
        for n in range(70)
    ]
    one, two = (
        answer({"figure": "rates", "form": "lines", "by": by, "series": "object", "bins": 2}, answered_)
        for by in ("yaw", "zoom")
    )
    (both,) = [text for text in one.text if text.startswith("Over all, the lowest share is that of")]
    assert (
        both in two.text
        and both in omit_repeated_sentences([one, two])[0]
        and both not in omit_repeated_sentences([one, two])[1]
    )


def test_values_that_come_round_are_counted_by_the_shorter_way() -> None:
    """Mugs are right near 0 and wrong behind, balls as often everywhere; 350 degrees are near 0."""
    asked = {"figure": "rates", "by": "yaw", "series": "group", "away_from": 0, "turn": 360, "bins": 2}
    answered_ = [
        answered({"object": name, "yaw": yaw}, (yaw < 90 or yaw > 270) if name == "mug" else n % 2 == 0)
        for name in ("mug", "ball")
        for yaw in (10.0, 60.0, 120.0, 200.0, 300.0, 350.0)
        for n in range(20)
    ]
    made = figure({**asked, "range": (0, 180)}, answered_, {"round objects": ["ball"]})
    assert counts(made) == {
        ("0 to 90", "other objects"): (80, 80), ("90 to 180", "other objects"): (0, 40),
        ("0 to 90", "round objects"): (40, 80), ("90 to 180", "round objects"): (20, 40),
        ("all", "other objects"): (80, 120), ("all", "round objects"): (60, 120),
    }  # fmt: skip
    mug, shown, ball, _ = made.text
    assert mug.startswith("For other objects, lowest where the distance of yaw from 0 is 90 to 180: right in 0 ")
    assert shown.startswith("The difference is shown") and ball.endswith(
        "the same share, 50 %: no difference is shown."
    )


def test_photographs_agree_with_the_renderings_whose_configurations_they_show() -> None:
    made = figure(EXAMPLES["agreement"], PICTURED)
    of_all = {row[0]: row[2:] for row in made.rows if row[1] == "all objects"}
    assert of_all["photographs"][:7] == [5, 1, 0, 2, 7, 7, 8] and of_all["through a sensor"][5] == 10
    assert of_all["photographs"][8:] == [*clopper_pearson(7, 8)]
    assert "right about both or wrong about both in 7 of 8 (88 %, 95 % interval 47-99.7 %)" in made.text[0]
    assert "it is right in 5 of 6" in made.text[0] and "wrong in 2 of 2" in made.text[0]
    assert made.text[2].startswith("1 of the photographs belongs to no rendering")


def test_the_rate_of_workers_is_that_after_the_first_quarter_and_their_gain_is_over_the_same_object() -> None:
    made = figure(EXAMPLES["scaling"], TIMED)
    expected = [[1, "mug", 4.0, 1.0], [1, "bowl", 8.0, 1.0], [2, "mug", 8.0, 2.0], [2, "bowl", 16.0, 2.0]]
    assert [row[:2] for row in made.rows] == [row[:2] for row in expected]
    assert [row[2:] for row in made.rows] == [pytest.approx(row[2:]) for row in expected]
    said = made.text
    assert "2 workers: 12 (8 to 16) pictures a second, 2 (2 to 2) times as many as 1 worker (100 % of linear)." in said
    assert "with a confidence of 50 %" in said[2]
    at_once = [replace(row, time=1.0) for row in TIMED]
    for few, message in ((at_once, "expected runs of several batches"), (PICTURED, "expected sweeps with `workers`")):
        with pytest.raises(InputError, match=message):
            figure(EXAMPLES["scaling"], few)


def test_a_quick_recipe_is_without_the_parts_that_it_leaves_out() -> None:
    described = read_recipe("scaling")
    runs = plan_runs(described, RecipeConfig(recipe="scaling", quick=True, object="mug"))
    assert [one.part for one in runs] == ["workers-1", "workers-2"] and runs[0].config.seed == runs[1].config.seed
    assert len(plan_runs(described, RecipeConfig(recipe="scaling", object="mug"))) == 4
    with pytest.raises(UnknownNameError, match="unknown part 'b'"):
        Recipe(title="a", parts={"a": {"command": "sweep"}}, quick={"without": ["b"]}).apply_quick()


def test_without_photographs_nothing_is_said_of_reality_and_they_are_in_no_figure_that_does_not_ask_for_them() -> None:
    rendered = [row for row in PICTURED if row.part != "photographs"]
    made = figure(EXAMPLES["agreement"], rendered)
    assert (
        made.text[0].startswith("There are no photographs yet: nothing is said about reality") and len(made.text) == 2
    )
    bars: dict[str, object] = {"figure": "rates", "by": "object"}
    assert figure(bars, PICTURED).rows == figure(bars, rendered).rows
    with pytest.raises(InputError, match="expected again to have the configurations of renderings"):
        figure(EXAMPLES["agreement"], rendered[1:])


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


def test_each_model_has_a_figure_unless_it_tells_them_apart() -> None:
    answered = [*rows({"noon": (2, 6)}, model="one"), *rows({"noon": (5, 6)}, model="two")]
    described = {"figure": "rates", "by": "environment", "title": "Hard"}
    found = list(make_figures(tabled(answered), *read_figure_options(described, "here")))
    assert [made.title for made in found] == ["Hard: one", "Hard: two"]
    assert [made.text[0][:29] for made in found] == ["noon: right in 2 of 6 (33 %, ", "noon: right in 5 of 6 (83 %, "]
    for told in ({"figure": "rates", "by": "model"}, {"figure": "rates", "by": "environment", "series": "model"}):
        assert len(list(make_figures(tabled(answered), *read_figure_options(told, "here")))) == 1


def test_a_curve_puts_each_value_in_its_part_of_the_range() -> None:
    answered = [
        Answered("a", {"object": "mug", "yaw": float(yaw)}, {"yaw": "degrees"}, "mug", yaw < 180) for yaw in range(361)
    ]
    made = figure({"figure": "rates", "by": "yaw", "bins": 4, "range": [0, 360]}, answered)
    assert list(counts(made).values()) == [(90, 90), (90, 90), (0, 90), (0, 91)]
    assert made.text[0].startswith("Lowest where yaw is 180 to 270 degrees (as 1 other): right in 0 of 90")


@pytest.mark.medium
@pytest.mark.parametrize("name", EXAMPLES)
def test_every_figure_is_drawn_and_is_a_table(name: str, tmp_path: Path) -> None:
    write_png(tmp_path / "parts" / "views-00-mug" / "images" / "surface.png", np.zeros((8, 8, 3)))
    own = {"agreement": PICTURED, "scaling": TIMED}
    table = tabled(own.get(name, EXAMPLE_ROWS), {"round": ["mug"]}, surfaces={"views-00-mug": SURFACE}, folder=tmp_path)
    (made,) = make_figures(table, *read_figure_options(EXAMPLES[name], "here"))
    assert made.title and made.text and all(one.endswith(".") for one in made.text)
    assert made.rows and all(len(row) == len(made.columns) for row in made.rows)
    assert draw_files(made)["png"].startswith(b"\x89PNG")


def test_every_kind_of_figure_has_an_example() -> None:
    assert {one["figure"] for one in EXAMPLES.values()} == FIGURES.keys()


EXAMPLE_ROWS = [
    replace(
        row,
        values={**row.values, "model": "m", "yaw": 10.0 * at, "water": at / 22, "milk": 0.5 - at / 22, "coffee": 0.5},
    )
    for at, row in enumerate(rows({"noon": (2, 6), "studio": (5, 6)}))
]
COUNTED = {"configurations": 20, "correct": 2, "accuracy": 0.1, "interval": (0.0, 0.3)}
SURFACE = SurfaceMap.of(
    {
        "file": "artifacts/surface.npz", "cells": 8, "least": 5,
        "tables": [
            {
                "object": "mug", "model": "m", "part": "cell", "unwrapped": False, "seen": 9, "compared": 7, "worse": 1,
                "better": 0,
                "strongest": [
                    {"face": 3, "u": 0.25, "v": 0.5, "place": (0.0, 0.0, 1.0), "seen": COUNTED, "hidden": COUNTED,
                     "difference": 0.4, "interval": (0.2, 0.6), "p": 0.01}
                ],
            }
        ],
    }
)  # fmt: skip
TIMED = [
    Answered(f"workers-{workers}", {"object": name, "workers": workers}, {}, "mug", True, 100.0 + at / (rate * workers))
    for workers in (1, 2)
    for name, rate in (("mug", 4), ("bowl", 8))
    for at in (*(0,) * 5, *range(16))
]
"""Five rows at once, then some at an even rate, in runs of two objects: two workers are twice as fast as one."""

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


@pytest.mark.parametrize(
    ("share", "shown"),
    [(0.35, "piggy bank, penny bank"), (0.2, "piggy bank"), (0.1, "piggy b…"), (0.06, "pigg…"), (0.04, "")],
)
def test_a_bar_shows_as_much_of_a_name_as_there_is_room_for(share: float, shown: str) -> None:
    assert shorten_to_fit("piggy bank, penny bank", share) == shown
