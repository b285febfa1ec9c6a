"""The Python interface as a person meets it: keywords, tables, and models without a gradient."""

import collections.abc
import inspect
import typing
from typing import Any, get_type_hints

import pytest
import torch

import advsearch
from advsearch.api import keywords as api_keywords
from advsearch.api.keywords import make_hint
from advsearch.config import CONFIGS
from advsearch.models import ModelWarning
from advsearch.questions.attack.python import AttackKeywords
from advsearch.questions.sweep.carry_out import SweepKeywords
from advsearch.settings import settings
from small_models import Brightness


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


@pytest.fixture(scope="module")
def model() -> advsearch.Model:
    return advsearch.load_model(Brightness(0.9, border=4), labels=["mug", "vase"], input_size=16, name="middle")


@pytest.fixture(scope="module")
def attacked(model: advsearch.Model, tmp_path_factory: pytest.TempPathFactory) -> Any:
    path = tmp_path_factory.mktemp("python") / "run"
    return advsearch.attack("mug", model, steps=2, spp=1, verify_spp=1, baseline=False, measure="no", run=path)


@pytest.fixture(scope="module")
def swept(model: advsearch.Model) -> advsearch.SweepResult:
    return advsearch.sweep("mug", model, {"pose.yaw": [0, 90], "camera.elevation": [10, 60]}, spp=1, trials=0)


def test_rows_become_a_table_of_pandas(attacked: Any, swept: advsearch.SweepResult) -> None:
    table = swept.to_pandas()
    assert table["pose.yaw"].tolist() == [0.0, 0.0, 90.0, 90.0]
    assert {"correct", "margin", "label", "camera.elevation"} <= set(table.columns)
    searched = attacked.to_pandas("search")
    assert len(searched) and set(searched["kind"]) == {"search"} and len(attacked.to_pandas()) > len(searched)


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
