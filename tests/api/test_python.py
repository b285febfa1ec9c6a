"""The Python interface as a person meets it: names, signatures, short texts, tables."""

from __future__ import annotations

import ast
import collections.abc
import inspect
import typing
from pathlib import Path
from typing import Any, get_type_hints

import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.api import keywords as api_keywords
from advsearch.api.keywords import make_hint
from advsearch.config import CONFIGS
from advsearch.errors import InputError
from advsearch.models import ModelWarning
from advsearch.questions.attack.python import AttackKeywords
from advsearch.questions.sweep.carry_out import SweepKeywords
from advsearch.settings import settings


def test_dir_lists_the_public_names() -> None:
    assert set(dir(advsearch)) == {*advsearch.__all__, "__version__"}


QUESTIONS = (
    *("attack", "sweep", "region", "replay", "recipe", "check", "precision", "stability", "harden"),
    *("explain", "compare"),
)


@pytest.mark.parametrize("name", QUESTIONS)
def test_signatures_have_every_setting_as_it_is_declared(name: str) -> None:
    function, declared = getattr(advsearch, name), settings(CONFIGS[name])
    parameters = inspect.signature(function).parameters
    assert not [one for one in parameters.values() if one.kind is one.VAR_KEYWORD]
    names = {one.field.removesuffix("_"): one for one in declared if not one.required}
    assert set(names) <= set(parameters)
    own = {
        "scene",
        "object",
        "attack",
        "recipe",
        "sweeps",
        "compared",
        "model",
        "grid",
        "resume",
        "progress",
        "optimiser",
        "loss",
        "beside",
        "tracker",
    }
    assert set(parameters) - set(names) <= own
    inner = inspect.signature(function.__wrapped__).parameters
    for key, one in names.items():
        if key not in inner:
            assert parameters[key].default == one.default, key
            assert f"{key}: {one.description}"[:60] in " ".join(function.__doc__.split()), key
    assert all(one.annotation is not inspect.Parameter.empty for one in parameters.values())


def test_editors_and_type_checkers_know_every_setting() -> None:
    """Each comment would be one too many, and mypy would say so, if a keyword had no type."""
    with pytest.raises(InputError, match=r"^steps: expected a whole number from 1 to 1000000, got many"):
        advsearch.attack("mug", steps="many")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"^sampler: expected sobol or random, got square"):
        advsearch.sweep("mug", sampler="square")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"^samples: expected a whole number from 8 to 1000000, got many"):
        advsearch.region("mug", samples="many")
    with pytest.raises(TypeError, match=r"stability\(\) got an unexpected keyword argument 'object'"):
        advsearch.stability(object="mug")


@pytest.mark.parametrize(
    ("function", "keywords", "command"),
    [(advsearch.attack, AttackKeywords, "attack"), (advsearch.sweep, SweepKeywords, "sweep")],
)
def test_typed_keywords_are_the_settings(function: Any, keywords: Any, command: str) -> None:
    """All that the function has no argument of its own for, each with what Python callers may write."""
    own = inspect.signature(function.__wrapped__).parameters
    fields, declared = CONFIGS[command].model_fields, settings(CONFIGS[command])
    optional = [one.field for one in declared if not one.required]
    expected = {field.removesuffix("_"): make_hint(field, fields[field].annotation) for field in optional}
    names = {**vars(typing), **vars(collections.abc), **vars(api_keywords)}
    hints = get_type_hints(keywords)
    assert hints.keys() == expected.keys() - own.keys()
    for name, hint in hints.items():
        assert hint == eval(expected[name], names), name


def test_type_checkers_see_every_public_name() -> None:
    """The block of imports, which nothing else reads, has each name that is imported on first use."""
    tree = ast.parse(Path(advsearch.__file__).read_text("utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    imported = {alias.name for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert imported == {*advsearch.__all__}


def test_an_argument_that_there_is_not_is_python_s_own_error() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'epsilonn'"):
        advsearch.attack("mug", epsilonn=0.1)  # type: ignore[call-arg]


class Middle(nn.Module):
    """Says the first class where the middle of a picture is dark, the second where it is bright."""

    def forward(self, images: Tensor) -> Tensor:
        score = 40.0 * (images[:, :, 4:-4, 4:-4].mean(dim=(1, 2, 3)) - 0.9)
        return torch.stack([-score, score], dim=1)


@pytest.fixture(scope="module")
def model() -> advsearch.Model:
    return advsearch.load_model(Middle(), labels=["mug", "vase"], input_size=16, name="middle")


@pytest.fixture(scope="module")
def attacked(model: advsearch.Model, tmp_path_factory: pytest.TempPathFactory) -> Any:
    path = tmp_path_factory.mktemp("python") / "run"
    return advsearch.attack("mug", model, steps=2, spp=1, verify_spp=1, baseline=False, measure="no", run=path)


@pytest.fixture(scope="module")
def swept(model: advsearch.Model) -> advsearch.SweepResult:
    return advsearch.sweep("mug", model, {"pose.yaw": [0, 90], "camera.elevation": [10, 60]}, spp=1, trials=0)


@pytest.mark.medium
def test_texts_are_short(model: advsearch.Model, attacked: Any, swept: advsearch.SweepResult) -> None:
    scene = advsearch.load_scene("mug", environment="loft", settings={"camera.azimuth": 60.0})
    assert repr(scene) == "Scene('mug', 'loft', camera.azimuth=60.0)"
    assert repr(model) == "Model('middle', 2 classes, 16 x 16 pixels)"
    assert repr(attacked).startswith("AttackResult('mug', 'texture', ") and len(repr(attacked)) < 250
    right = swept.summary.correct
    assert repr(swept) == f"SweepResult('mug', 'middle', {right} of 4 right, run=None)"


def test_a_notebook_shows_verdict_pictures_and_tables(attacked: Any, swept: advsearch.SweepResult) -> None:
    page = attacked._repr_html_()
    assert page.count('<img src="data:image/png;base64,') == 2 and "<th>95 % interval</th>" in page
    assert "<td>clean</td>" in page and "<script" not in page
    page = swept._repr_html_()
    assert page.count("<img") == 1 and "<b>pose.yaw, degrees</b>" in page and "<td>90</td>" in page


def test_rows_become_a_table_of_pandas(attacked: Any, swept: advsearch.SweepResult) -> None:
    table = swept.to_pandas()
    assert table["pose.yaw"].tolist() == [0.0, 0.0, 90.0, 90.0]
    assert {"correct", "margin", "label", "camera.elevation"} <= set(table.columns)
    searched = attacked.to_pandas("search")
    assert len(searched) and set(searched["kind"]) == {"search"} and len(attacked.to_pandas()) > len(searched)


def test_a_region_is_asked_for_by_name() -> None:
    with pytest.raises(InputError, match=r"^map: expected a whole number from 0 to 512, got 600"):
        advsearch.region("mug", controls="camera", map=600)


def test_an_attack_has_one_environment() -> None:
    with pytest.raises(InputError, match="environment: expected one"):
        advsearch.attack("mug", environment=["studio", "sunset"])


class Rounding(torch.nn.Module):
    """Answers by the brightness, and lets no gradient through."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        mean = torch.from_numpy(images.detach().numpy()).mean(dim=(1, 2, 3))
        return torch.stack([mean, 0.5 - mean], dim=1)


@pytest.mark.medium
def test_a_model_without_a_gradient_is_searched_without_one() -> None:
    with pytest.warns(ModelWarning, match="no gradient .* use `auto`"):
        model = advsearch.load_model(Rounding(), labels=["light", "dark"], input_size=16)
    small: dict[str, Any] = {"resolution": 16, "spp": 1, "trials": 6, "baseline": False, "denoise": "none"}
    controls = {"texture": {"resolution": 4, "epsilon": 1.0}}
    result = advsearch.attack("mug", model, controls=controls, label="light", steps=24, **small)
    assert result.search is not None
    assert result.search.gradients == 0
    assert len({round(step.objective, 4) for step in result.search.history}) > 5, "it moves"
