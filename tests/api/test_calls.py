"""What a call from Python gives: keywords of other libraries, and values of wrong types."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

import advsearch
from advsearch import losses
from advsearch.attacks import get_objective
from advsearch.calls import OTHER_TERMS, check_types, make_unexpected_error
from advsearch.controls import NumberControl, Parameter, compose
from advsearch.engine.loading import load_scene
from advsearch.errors import InputError
from advsearch.tasks import Classification

ANY: Any = advsearch
FUNCTIONS = [name for name in advsearch.__all__ if inspect.isfunction(getattr(advsearch, name))]


@pytest.mark.parametrize(
    ("name", "keyword", "meant"),
    [
        ("attack", "eot", "`over`"),
        ("attack", "minimal_perturbation", "`smallest`"),
        ("attack", "epsilons", "`epsilon`"),
        ("sweep", "n_samples", "`samples`"),
        ("load_scene", "enviroment", "`environment`"),
    ],
)
def test_a_keyword_of_elsewhere_is_told_what_it_is_called_here(name: str, keyword: str, meant: str) -> None:
    with pytest.raises(
        TypeError, match=f"{name}.. got an unexpected keyword argument '{keyword}'; did you mean {meant}"
    ):
        getattr(advsearch, name)("mug", **{keyword: 1})


def test_a_device_has_no_name_here() -> None:
    with pytest.raises(TypeError, match=r"'device' \(pictures.*a model stays on the device that it is on"):
        ANY.attack("mug", device="cuda")


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name != "allow_code"])
def test_every_function_says_which_keywords_it_has_not(name: str) -> None:
    """A function that is not `helped` would raise Python's own error, without a word about what is meant."""
    known = list(inspect.signature(getattr(advsearch, name)).parameters)
    wrong = known[-1] + "s_"
    with pytest.raises(TypeError, match=f"{name}.. got an unexpected keyword argument '{wrong}'; did you mean"):
        getattr(advsearch, name)("mug", **{wrong: 1})


def test_every_other_term_leads_to_a_keyword_of_some_function() -> None:
    known = {key for name in FUNCTIONS for key in inspect.signature(getattr(advsearch, name)).parameters}
    assert set(OTHER_TERMS.values()) <= known
    assert make_unexpected_error("f", {"a": 1}, ["a"]) is None


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name != "load_run"])
@pytest.mark.parametrize("run", [False, True, 3, [], b"x", " "])
def test_a_run_is_a_name_or_a_folder(name: str, run: Any) -> None:
    if "run" in inspect.signature(getattr(advsearch, name)).parameters:
        with pytest.raises(InputError, match="run: expected "):
            getattr(advsearch, name)(*(["mug"] if name in ("attack", "sweep") else []), run=run)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (partial(ANY.attack, False), "scene: expected a Scene, a text, a path or a mapping, got False"),
        (partial(ANY.attack, "mug", resume=1), "resume: expected True or False, got 1"),
        (partial(ANY.attack, "mug", metrics=[]), r"metrics: expected a mapping or None, got \[\]"),
        (partial(ANY.attack, "mug", policy={}), "policy: expected a name, a mapping with a `name`"),
        (partial(ANY.attack, "mug", policy=""), "policy: expected a name, a mapping with a `name`"),
        (partial(ANY.attack, "mug", objective=3), "objective: expected a text, a function or None, got 3"),
        (partial(ANY.load_scene, 3.5), "object: expected a text, a path or a ObjectAsset, got 3.5"),
        (partial(ANY.load_scene, "mug", camera=True), "camera: expected a text or None, got True"),
        (partial(ANY.render, "mug", spp="a"), "spp: expected a whole number, got 'a'"),
        (partial(ANY.render, "mug", seed=0.5), "seed: expected a whole number, got 0.5"),
        (partial(ANY.load_model, 3), "spec: expected a text, a path, a Module or a Model, got 3"),
    ],
)
def test_a_value_of_another_type_is_refused_in_a_sentence(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()


def test_types_that_are_told() -> None:
    def function(a: int = 0, b: str | Path | None = None, c: list[int] | None = None) -> None: ...

    parameters = inspect.signature(function).parameters
    check_types(parameters, {"a": 3, "b": Path("x"), "c": None})
    for name, value in (("a", True), ("a", 0.5), ("b", 3)):
        with pytest.raises(InputError, match=f"{name}: expected"):
            check_types(parameters, {name: value})


# ---- losses that lead away from a target ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "loss", [F.cross_entropy, F.nll_loss, nn.CrossEntropyLoss(), partial(F.cross_entropy, reduction="none")]
)
def test_a_loss_of_torch_that_leads_away_from_the_target_is_refused(loss: Any) -> None:
    with pytest.raises(InputError, match=r"objective: it is maximised, and torch's \w+ falls towards the `target`"):
        losses.check_direction(loss, targeted=True)
    losses.check_direction(loss, targeted=False)
    losses.check_direction(lambda logits, labels: -loss(logits, labels), targeted=True)


def test_a_loss_of_ones_own_that_leads_away_from_the_target_warns_once() -> None:
    def away(logits: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        return F.cross_entropy(logits, labels, reduction="none")

    def towards(logits: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        return -away(logits, images, labels)

    task = Classification(labels=("mug", "bowl"), target=(1,))
    logits, pictures = torch.tensor([[2.0, 1.0]], requires_grad=True), torch.rand(1, 2, 2, 3)
    objective = get_objective(away, task)
    with pytest.warns(UserWarning, match="objective 'away' falls as the target becomes more likely"):
        objective(logits, pictures, (0,))
    objective(logits, pictures, (0,))  # warnings are errors here: it is said once
    get_objective(towards, task)(logits, pictures, (0,))
    get_objective(away, Classification(labels=("mug", "bowl")))(logits, pictures, (0,))


# ---- controls of one's own ------------------------------------------------------------------------------------------


class Sets(NumberControl):
    """Sets one input of the scene."""

    kind = "sets"
    summary = "Sets one input."
    parameters = (Parameter("amount", (), "1", 0.0, 1.0, 0.0, "How much.", search=(0.0, 1.0)),)
    made: Any = None

    def scene_inputs(self, values: Any, so_far: Any) -> Any:
        return self.made


@pytest.mark.parametrize(
    ("made", "message"),
    [
        ({"object.base_color": torch.full((4, 4, 3), 1.5)}, "object.base_color: expected values from 0 to 1 .*got 1.5"),
        ({"object.base_color": torch.full((4, 4, 3), -0.1)}, "expected values from 0 to 1 .* got -0.1;?"),
        ({"object.base_color": torch.full((4, 4, 3), torch.nan)}, "object.base_color: expected values from 0 to 1"),
        ({"object.base_color": torch.zeros(4, 4)}, r"object.base_color: expected shape \(N, N, 3\), got \(4, 4\)"),
        ({"object.to_world": torch.eye(3)}, r"object.to_world: expected shape \(4, 4\), got \(3, 3\)"),
        ({"object.roughness": torch.tensor([2.0])}, "object.roughness: expected values from 0 to 1"),
        ({"object.base_color": torch.zeros(4, 4, 3, dtype=torch.uint8)}, "expected a tensor .* got torch.uint8"),
        ({"object.base_color": 0.5}, "expected a tensor of real numbers, got float"),
        (torch.zeros(3), "expected scene inputs by name, got Tensor"),
    ],
)  # fmt: skip
def test_inputs_of_ones_own_control_that_cannot_be_are_refused(made: Any, message: str) -> None:
    control = Sets(amount=[0, 1])
    control.made = made
    space = compose((control,), load_scene("mug").description)
    with pytest.raises(InputError, match=f"`controls` sets: .*{message}"):
        space.inputs(space.start)


def test_inputs_that_rounding_has_put_a_little_out_are_fine() -> None:
    control = Sets(amount=[0, 1])
    control.made = {"object.base_color": torch.full((4, 4, 3), 1.0 + 1e-6)}
    space = compose((control,), load_scene("mug").description)
    assert space.inputs(space.start)["object.base_color"].shape == (4, 4, 3)
