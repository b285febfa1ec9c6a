"""Whatever code of others is handed, it may destroy: nothing that it writes into is looked at again."""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from advsearch.attacks import Block, Domain, Evaluation, Policy, Proposal, get_objective, search
from advsearch.attacks.objectives import OBJECTIVE_KINDS, ObjectiveKind
from advsearch.controls import CONTROLS, NumberControl, Parameter, compose_space
from advsearch.copies import copy_value
from advsearch.engine.judging import judge_images
from advsearch.engine.loading import load_scene, make_controls
from advsearch.errors import InputError
from advsearch.models import Model, Preprocessing
from advsearch.tasks import Classification, Facts, Prediction, Sight, Task, make_task
from samples import load_photographed_box

LOGITS = torch.tensor([[3.0, 1.0, 0.0], [0.5, 2.0, 0.0]])
PICTURES = torch.rand(2, 4, 4, 3, generator=torch.Generator().manual_seed(0))
MUG = load_scene("mug").description
TASK = replace(Classification(), labels=("mug", "bowl", "vase"))


def destroy(value: Any) -> None:
    """Write into every tensor and array of a value, and empty its lists and mappings."""
    if isinstance(value, Tensor):
        with torch.no_grad():
            value.fill_(7)
    elif isinstance(value, np.ndarray):
        value[...] = 7
    elif isinstance(value, (list, dict)):
        for one in [*(value.values() if isinstance(value, dict) else value)]:
            destroy(one)
        value.clear()
    elif isinstance(value, tuple):
        for one in value:
            destroy(one)
    elif isinstance(value, (SimpleNamespace, Evaluation, Domain)):
        destroy({**vars(value)})


@dataclass(frozen=True, kw_only=True)
class Vandal(Classification):
    """A task that destroys what it is asked about."""

    name = "vandal"

    def loss(self, output: Tensor, truth: Any) -> Tensor:
        found = super().loss(output, truth).clone()
        destroy([output, truth])
        return found

    def predictions(self, output: Tensor, count: int = 1) -> list[tuple[Prediction, ...]]:
        found = super().predictions(output, count)
        destroy(output)
        return found


def test_a_loss_that_masks_logits_in_place_changes_no_verdict() -> None:
    def masks(logits: Tensor, images: Tensor, labels: Tensor, u: Tensor) -> Tensor:
        right = torch.stack([row[label] * 1.0 for row, label in zip(logits.clone(), labels.tolist(), strict=True)])
        value = logits.scatter_(1, labels[:, None].clone(), -1e4).amax(dim=1) - right
        destroy([images, labels, u])
        return value

    output, u = LOGITS.clone().requires_grad_(), torch.rand(2, 5)
    images, kept = PICTURES.clone(), u.clone()
    values = get_objective(masks, TASK)(output, images, (0,), {"u": u}.__getitem__)
    (slope,) = torch.autograd.grad(values.sum(), output)
    assert torch.equal(values, TASK.loss(LOGITS, (0,)))
    assert torch.equal(slope, torch.tensor([[-1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]))
    assert torch.equal(output, LOGITS) and torch.equal(images, PICTURES) and torch.equal(u, kept)


@pytest.mark.parametrize("lifts", [False, True])
def test_a_loss_that_torch_cannot_differentiate_after_it_wrote_is_refused(lifts: bool) -> None:
    def slips(logits: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        right, value = logits.gather(1, labels[:, None])[:, 0], logits.amax(dim=1)
        if lifts:
            with torch.no_grad():
                logits.scatter_(1, labels[:, None], 1e4)
            return value - right
        return logits.scatter_(1, labels[:, None], -1e4).amax(dim=1) - right

    objective = get_objective(slips, TASK)
    with pytest.raises(InputError, match="objective 'slips': it writes into what it is given"):
        objective(LOGITS.clone().requires_grad_(), PICTURES, (0,))
    assert objective(LOGITS, PICTURES, (0,)).shape == (2,)  # without derivatives there is nothing wrong with it


def test_a_loss_of_boxes_may_destroy_its_lists() -> None:
    def clears(output: list[Any], images: Tensor, truth: Any) -> Tensor:
        value = torch.stack([one["scores"].amax() for one in output])
        destroy(output)
        return value

    output = [{"scores": LOGITS[:1].clone().requires_grad_()}, {"scores": LOGITS[1:].clone().requires_grad_()}]
    values = get_objective(clears, replace(Vandal(), labels=TASK.labels))(output, PICTURES, (0,))
    assert values.requires_grad and [len(one) for one in output] == [1, 1]
    assert torch.equal(torch.cat([one["scores"] for one in output]), LOGITS)


def test_an_objective_of_another_package_may_destroy_what_it_gets(monkeypatch: pytest.MonkeyPatch) -> None:
    def made(task: Task) -> Any:
        def objective(output: Tensor, images: Tensor, truth: Any, more: Any = None, /) -> Tensor:
            value = output[:, 1] * 1.0
            destroy([output, images])
            return value

        return objective

    kind = ObjectiveKind("destroying", "it destroys", "none", task=None, of_task=made)
    entry_point: Any = SimpleNamespace(value="elsewhere:KIND", load=lambda: kind)
    monkeypatch.setitem(OBJECTIVE_KINDS._installed, kind.name, entry_point)
    output, images = LOGITS.clone(), PICTURES.clone()
    assert torch.equal(get_objective("destroying", TASK)(output, images, (0,)), LOGITS[:, 1])
    assert torch.equal(output, LOGITS) and torch.equal(images, PICTURES)


def test_a_metric_that_destroys_what_it_gets_changes_no_other() -> None:
    def first(image: Tensor, output: Tensor, truth: Tensor) -> float:
        destroy([image, output, truth])
        return 0.0

    def second(image: Tensor, output: Tensor, truth: Tensor) -> dict[str, Tensor]:
        return {"output": output.sum(), "image": image.sum(), "truth": truth}

    output, pictures = LOGITS.clone(), PICTURES.clone()
    said = judge_images(TASK, output, pictures, [(1,)], {"first": first, "second": second})
    assert [one.metrics for one in said] == [
        {"first": 0.0, "second.output": float(row.sum()), "second.image": float(picture.sum()), "second.truth": 1.0}
        for row, picture in zip(LOGITS, PICTURES, strict=True)
    ]
    assert torch.equal(output, LOGITS) and torch.equal(pictures, PICTURES)


def test_a_task_that_destroys_what_it_judges_says_what_one_that_does_not_says() -> None:
    vandal, output = replace(Vandal(), labels=TASK.labels), LOGITS.clone()
    assert vandal.judge(output, (0,)) == TASK.judge(LOGITS, (0,))
    assert torch.equal(output, LOGITS)


def test_a_task_from_a_function_and_the_facts_that_it_gets() -> None:
    def judge(output: Tensor, truth: Facts) -> Tensor:
        value = output[:, 0] - truth.mask.sum()
        destroy([output, truth.mask, truth.depth, truth.z_depth])
        return value

    mask = torch.ones(2, 2, dtype=torch.bool)
    facts = Facts(
        "mug",
        compute_numbers=lambda: {"pose.yaw": 1.0},
        compute_sight=lambda: Sight(mask, torch.ones(2, 2), torch.ones(2, 2)),
    )
    task, output = make_task(judge), LOGITS.clone()
    assert [one.margin for one in task.judge(output, facts)] == [1.0, 3.5]
    assert torch.equal(output, LOGITS) and mask.all() and facts.depth.eq(1).all() and facts.z_depth.eq(1).all()
    with pytest.raises(TypeError):
        facts.numbers["pose.yaw"] = 2.0  # type: ignore[index]


@dataclass(frozen=True)
class Walking(Policy[Any]):
    """A policy that goes on with what it was handed, in place, as loops of torch do; or with copies."""

    name = "walking"
    uses_gradient = True
    in_place: bool = True

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> Any:
        return domain, domain.initial_point if self.in_place else domain.initial_point.clone()

    def propose(self, state: Any, n: int) -> tuple[tuple[Proposal, ...], Any]:
        domain, u = state
        u.add_(0.04) if self.in_place else (u := u + 0.04)
        return (Proposal(u, gradient=True),), (domain, u)

    def update(self, state: Any, evaluated: Any) -> Any:
        if self.in_place:
            state[1].copy_(evaluated[-1][0])
            destroy([*evaluated])
        return state


def test_a_policy_that_writes_into_what_it_is_handed_moves_no_budget() -> None:
    def evaluate(queries: Any, *, destroys: bool) -> Any:
        for query in queries:
            gradient, value = query.u * 2.0, float(query.u.sum())
            if destroys:
                destroy(query.u)
            yield Evaluation(value, gradient, value > 2.0)

    def told(destroys: bool) -> Any:
        return (lambda record, u, evaluation: destroy([u, evaluation])) if destroys else None

    found = []
    for destroys in (False, True):
        domain = Domain(torch.full((4,), 0.5), (Block(4, "linf", 0.2),))
        result = search(
            partial(evaluate, destroys=destroys), domain, Walking(destroys), steps=5, seed=0, on_step=told(destroys)
        )
        assert domain.start.eq(0.5).all() and domain.upper_bounds.eq(0.7).all()
        found.append((result.best_u.tolist(), [one.objective for one in result.history], result.agreement))
    assert found[0] == found[1]
    domain = Domain(torch.full((4,), 0.5), (Block(4, "linf", 0.2),))
    with pytest.raises(RuntimeError, match="policy 'walking' left its budget"):
        search(partial(evaluate, destroys=True), domain, Walking(), steps=9, seed=0)


class DimControl(NumberControl):
    """A control that destroys what it is handed."""

    kind = "dim"
    summary = "Destroys."
    parameters = (Parameter("amount", (), "1", 0.0, 1.0, 0.2, "How much.", search=(0.0, 1.0)),)

    refines = frozenset({"object.base_color"})

    def scene_inputs(self, values: Any, earlier_inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        found = earlier_inputs["object.base_color"].clone() * (1.0 - values["amount"].clone())
        destroy([*values.values(), *earlier_inputs.values()])
        return {"object.base_color": found}

    def on_picture(self, values: Any, image: Tensor) -> Tensor:
        return image.mul_(1.0 - values["amount"])

    def compute_measurements(self, values: Any, earlier_inputs: Mapping[str, Tensor]) -> dict[str, Any]:
        destroy([*earlier_inputs.values(), *values.values()])
        return {}


def test_a_control_that_destroys_what_it_is_handed() -> None:
    space = compose_space([*make_controls(["texture"]), DimControl(amount=[0, 1])], MUG)
    u = space.start.clone()
    image = torch.rand(4, 4, 3)
    kept_u, kept, before = u.clone(), image.clone(), space.inputs(u)["object.base_color"].clone()
    assert torch.allclose(space.apply_to_image(u, image), kept * 0.8)
    space.describe(u)
    assert torch.equal(space.inputs(u)["object.base_color"], before)
    assert torch.equal(u, kept_u) and torch.equal(image, kept)
    at = u.clone().requires_grad_()
    assert torch.autograd.grad(space.inputs(at)["object.base_color"].sum(), at)[0].count_nonzero() > 1000


@pytest.mark.parametrize("kind", [one for one in CONTROLS if one not in ("path", "mitsuba")])
def test_what_a_space_hands_out_may_be_destroyed(kind: str) -> None:
    """A loop of one's own gets tensors that nothing else reads."""
    scenes: dict[str, Any] = {"body": {"object": "person"}, "things": {"object": "mug", "things": "bottle@0.4,0.1"}}
    scene = load_scene(**scenes[kind]).description if kind in scenes else MUG
    if kind == "backdrop":
        scene = load_photographed_box().description
    space = compose_space(make_controls([kind]), scene)
    u = space.start.clone()
    first = {
        ask: copy_value(getattr(space, ask)(u)) for ask in ("inputs", "get_printable_colors", "get_numeric_values")
    }
    for ask in first:
        destroy(getattr(space, ask)(u))
    destroy(space.start)
    for ask, before in first.items():
        again = getattr(space, ask)(space.start)
        assert all(torch.equal(again[name], before[name]) for name in before), ask


class Writing(nn.Module):
    """A network that normalises in place, and answers into the same memory each time."""

    def __init__(self) -> None:
        super().__init__()
        self.answer = torch.empty(1, 2)

    def forward(self, x: Tensor) -> Tensor:
        x.sub_(0.5)
        self.answer = self.answer if not x.requires_grad else torch.empty(1, 2)
        return self.answer.copy_(torch.stack([x.sum(), -x.sum()])[None])


@pytest.mark.parametrize("layout", ["NHWC", "NCHW"])
@pytest.mark.parametrize("processor", [None, lambda x: x.sub_(0.5).div_(0.5)])
def test_a_network_that_writes_into_its_input_changes_no_picture(layout: str, processor: Any) -> None:
    preprocessing = Preprocessing((4, 4), layout=layout, processor=processor)
    model = Model(Writing(), "writing", ("a", "b"), preprocessing, batch_limits=(1, 1))
    pictures = PICTURES.clone()
    output = model(pictures)
    assert torch.equal(pictures, PICTURES)
    assert not torch.equal(output[0], output[1])
    first = model(pictures[:1])
    kept = first.clone()
    model(pictures[1:])
    assert torch.equal(first, kept) and torch.equal(first[0], output[0])


UNTOUCHED: dict[Any, set[str]] = {
    Task: {"read", "on", "with_objective", "check", "truth", "check_numbers", "wrap_network"},
    Policy: {"propose", "takes_differences", "counts", "distribution", "failures"},
    NumberControl: {
        *(
            "declare_parameters", "get_setting_name", "to_settings", "select_form", "get_mesh", "with_scene",
            "list_allowed_values", "list_allowed_names", "is_searched", "resolve_parameter",
        ),
        *(
            "get_clean_value", "get_value_without_control", "get_parameter_spec", "get_budget",
            "must_start_at_clean_value", "record_adjusted_default", "compute_values", "advance_time", "scale_ambient",
        ),
    },
}  # fmt: skip
"""Methods that get no tensors which anybody else reads; those of a declaration get the control's copy of a scene."""


@pytest.mark.parametrize("base", UNTOUCHED, ids=lambda base: base.__name__)
def test_every_method_that_another_package_may_write_gets_copies(base: type) -> None:
    """A new hook is wrapped too, or listed above."""
    methods = {name: one for name, one in inspect.getmembers(base, inspect.isfunction) if not name.startswith("_")}
    own = type("Own", (base,), {**{name: partial_of(one) for name, one in methods.items()}, "__module__": "elsewhere"})
    asked = {name for name, one in methods.items() if len(inspect.signature(one).parameters) > 1}
    wrapped = {name for name in asked if hasattr(vars(own)[name], "__wrapped__")}
    assert asked - wrapped <= UNTOUCHED[base]


def partial_of(method: Any) -> Any:
    def own(self: Any, *args: Any) -> Any:
        return method(self, *args)

    return own


def test_what_is_copied() -> None:
    at = torch.ones(2, requires_grad=True)
    value: Any = {
        "a": [at * 2.0, np.zeros(2)],
        "b": (SimpleNamespace(c=torch.zeros(1)), Evaluation(1.0, torch.ones(1), True)),
    }
    found = copy_value(value)
    destroy(found)
    assert [one.tolist() for one in value["a"]] == [[2.0, 2.0], [0.0, 0.0]]
    held: Any
    evaluation: Any
    held, evaluation = value["b"]
    assert held.c.tolist() == [0.0] and evaluation.gradient.tolist() == [1.0]
    assert copy_value([at * 2.0])[0].requires_grad and copy_value("text") == "text"
