"""What pictures are judged by: what is true of a scene, and metrics, numbers of one's
own for every picture.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from operator import attrgetter
from types import MappingProxyType
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.attacks import Block, Domain, Evaluation, Objective, get_objective
from advsearch.attacks.objectives import OBJECTIVE_KINDS, More, labels_of, nothing_more
from advsearch.controls import Space
from advsearch.controls.base import Control
from advsearch.copies import copied
from advsearch.engine.loading import Scene
from advsearch.engine.rendering import render
from advsearch.errors import InputError, UnknownNameError
from advsearch.files import JsonObject
from advsearch.models import Model
from advsearch.models.features import features_of
from advsearch.options import Value, check_takes
from advsearch.report.wording import seen_text
from advsearch.runs.export import AFTER, OWN
from advsearch.runs.results import PrintTerms
from advsearch.scene.description import OBJECT
from advsearch.scene.formation import Surfaces
from advsearch.scene.renderer import Renderer
from advsearch.scene.things import ALL
from advsearch.tasks import Facts, Judgement, Task
from advsearch.tasks.base import Output, Truth, mean
from advsearch.tasks.together import Ensemble, Outputs, Together, of_each
from advsearch.trust.code import check_import, current_directory_importable

Metric = Callable[[Tensor, Any, Any], Any]
"""f(image, output, truth), which returns a number, or numbers by name. Where one name
is right, `truth` is its index, a tensor without axes.
"""

Metrics = Mapping[str, Metric]

MAIN = "__main__"  # the script that runs, which has another name in every other process


def metrics_as_settings(metrics: Mapping[str, str | Metric]) -> dict[str, str]:
    """Return metrics as a file names them: "package.module:function"; one that cannot
    be named, by its bare name.
    """
    if not isinstance(metrics, Mapping) or not all(
        isinstance(name, str) for name in metrics
    ):
        raise InputError(
            "metrics: expected a mapping from names to functions, as "
            f'{{"f": f}}, got {metrics!r:.80}'
        )
    settings = {}
    for name, function in metrics.items():
        if name in (*OWN, *AFTER) or not name:
            raise InputError(
                f"metrics: {name!r} is a column that rows have already; "
                "choose another name"
            )
        if isinstance(function, str):
            settings[name] = function
            continue
        if not callable(function):
            raise InputError(
                f"metrics: {name}: expected a function of (image, output, "
                f"truth), got {function!r:.80}"
            )
        check_takes(f"metrics: {name}", function, "image", "output", "truth")
        module = str(getattr(function, "__module__", None))
        place = str(getattr(function, "__qualname__", None))
        named: Any = sys.modules.get(module)
        for part in place.split("."):
            named = getattr(named, part, None)
        bare = str(getattr(function, "__name__", type(function).__name__))
        settings[name] = f"{module}:{place}" if named is function else bare
    return settings


def only_here(settings: Mapping[str, str]) -> list[str]:
    """Return the metrics, by name, that no file can name."""
    return [
        name
        for name, text in settings.items()
        if ":" not in text or text.startswith(f"{MAIN}:")
    ]


def check_shared(settings: Mapping[str, str]) -> None:
    for name in only_here(settings):
        raise InputError(
            f"metrics: {name}: workers import a metric by its name, and "
            f"{settings[name].rpartition(':')[2]} has none "
            "that they could; write it as a function of a module, or leave `workers` "
            "and `cluster` out"
        )


def load_metrics(
    settings: Mapping[str, str], given: Mapping[str, str | Metric] | None = None
) -> Metrics:
    """Return the functions that settings name; `given` ones are there already, and take
    their place.
    """
    functions: dict[str, Any] = {}
    for name, text in settings.items():
        functions[name] = (given or {}).get(name)
        if callable(functions[name]):
            continue
        module, colon, attribute = text.partition(":")
        if not colon or not attribute:
            raise InputError(
                f"metrics: {name}: expected package.module:function, got {text!r}"
            )
        check_import(text)
        try:
            with current_directory_importable():
                functions[name] = attrgetter(attribute)(import_module(module))
        except Exception as error:  # the user's code may raise anything
            raise InputError(
                f"metrics: {name}: {text} cannot be imported ({type(error).__name__}: "
                f"{error}); a module is looked for "
                f"on the Python path and in {os.getcwd()}"
            ) from error
        if not callable(functions[name]):
            got = f"{functions[name]!r:.80}"
            raise InputError(
                f"metrics: {name}: expected a function of (image, output, "
                f"truth), got {got}"
            )
    return functions


def judgements(
    task: Task,
    output: Output,
    pictures: Tensor,
    truths: Sequence[Truth],
    metrics: Metrics = MappingProxyType({}),
) -> list[Judgement]:
    """Return what a task and metrics say of pictures (N, H, W, 3), sRGB in [0, 1]: the
    one place where a run judges. Each picture has its truth, or one is for all.
    """
    with torch.no_grad():
        if len(truths) == 1:
            said = task.judge(output, truths[0])
            truths = [truths[0]] * len(pictures)
        else:
            said = [
                task.judge(output[k : k + 1], truth)[0]
                for k, truth in enumerate(truths)
            ]
    if not metrics:
        return said
    return [
        measured(said[k], metrics, pictures[k], output[k : k + 1], truth)
        for k, truth in enumerate(truths)
    ]


def with_things(judgement: Judgement, things: JsonObject | None) -> Judgement:
    """Return a judgement whose payload has what the picture shows of each thing, beside
    what is said of it.
    """
    if things is None or judgement.not_a_number:
        return judgement
    kept = judgement.payload if isinstance(judgement.payload, dict) else {}
    said: Any = kept.get("things", {})
    shown: Any = {name: {**seen, **said.get(name, {})} for name, seen in things.items()}  # type: ignore[dict-item]
    return replace(judgement, payload={**kept, "things": shown})


def measured(
    judgement: Judgement, metrics: Metrics, image: Tensor, output: Output, truth: Truth
) -> Judgement:
    """Return the judgement of a picture (H, W, 3), sRGB in [0, 1], with what metrics
    say of it. A metric gets the truth as an objective does, of one picture; all that it
    gets are copies.
    """
    returned = dict[str, Any]()
    numbers = dict[str, float | None]()
    seen, right = _of_one(output, truth)
    with torch.no_grad():
        for name, metric in metrics.items():
            value = metric(*copied((image.detach(), seen, right)))
            if isinstance(value, Mapping):
                returned |= {f"{name}.{key}": each for key, each in value.items()}
            else:
                returned[name] = value
        for name, value in returned.items():
            try:
                number = float(value)
            except (TypeError, ValueError, RuntimeError):
                expected = "a number, or a dict from names to numbers"
                raise InputError(
                    f"metrics: {name}: expected {expected}, got {value!r:.80}"
                ) from None
            numbers[name] = number if math.isfinite(number) else None
    return replace(judgement, metrics=numbers)


def _of_one(output: Output, truth: Truth) -> tuple[Any, Any]:
    """The output and the truth of one picture as a metric gets them; of several models,
    a tuple of each.
    """
    first = output[0]
    if isinstance(first, (tuple, list)):
        each = [_of_one(*both) for both in zip(first, truth, strict=True)]
        return tuple(seen for seen, _ in each), tuple(right for _, right in each)
    labels = labels_of(truth, output, 1)
    return first, labels[0] if isinstance(labels, Tensor) else labels


def mean_metrics(judgements: Sequence[Judgement]) -> dict[str, float | None] | None:
    """Return the mean of each metric over pictures of which it is a number; None where
    there are no metrics.
    """
    each = [
        judgement.metrics for judgement in judgements if judgement.metrics is not None
    ]
    names = dict.fromkeys(name for metrics in each for name in metrics)
    numbers = {
        name: [number for metrics in each if (number := metrics.get(name)) is not None]
        for name in names
    }
    return {
        name: mean(known) if known else None for name, known in numbers.items()
    } or None


LOOK_SPP = 16  # samples a pixel of the clean picture that the model is shown

Described = Callable[[], Mapping[str, Value]]
"""What says the configuration in named values, when it is asked."""

Looked = Callable[[], Surfaces]
"""What says what the camera sees, when it is asked."""


def calibrate_task(
    task: Task,
    model: Model,
    scenes: Sequence[Scene],
    label: str | None,
    judge: str,
    image_settings: Mapping[str, Any],
) -> Task:
    """Return the task after it has seen what its model predicts of clean images, where
    it `calibrates`.

    The next scene is rendered where those before leave open how predictions are to be
    read.

    Args:
        task: of the model.
        model: whose predictions are read.
        scenes: in order.
        label: what is right; None for the label of each object.
        judge: the thing that is judged.
        image_settings: keywords of `render` for the images that the model sees, see
            `SceneConfig.image_settings`.
    """
    if not task.calibrates:
        return task
    for scene in scenes:
        rendering = render(
            scene,
            model,
            task=task,
            label=label,
            judge=OBJECT if judge == ALL else judge,
            spp=LOOK_SPP,
            **image_settings,
        )
        view = rendering.views[0]
        task = task.after_calibration(view.output, view.truth)
        if not task.ambiguities:
            return task
    raise InputError(f"model {model.name}: {task.ambiguities}")


def check_truth(
    task: Task,
    model: Model,
    scene: Scene,
    facts: Facts,
    image_settings: Mapping[str, Any],
) -> None:
    """Refuse a scene of which the task cannot say what is right, before anything is
    prepared.

    Where no label is stated, the message has the model's first predictions of a clean
    image; `image_settings` as for `calibrate_task`.
    """
    try:
        for each in facts.each.values() or (facts,):
            task.check(each)
    except InputError as error:
        if facts.label is not None:
            raise
        predictions = (
            render(scene, model, task=task, spp=LOOK_SPP, **image_settings)
            .views[0]
            .predictions
        )
        said = ", ".join(
            seen_text(task.name, replace(each, label=repr(each.label)))
            for each in predictions
        )
        term = f"#{predictions[0].index}"
        # the label, where that names this class and no other
        with suppress(InputError):
            if model.label_set(predictions[0].label).indices == (predictions[0].index,):
                term = predictions[0].label
        raise InputError(
            f"{error}; model {model.name} calls a clean picture of it {said}; name "
            "what is right, such as "
            f'`label="{term}"`'
        ) from None


def one_label_for_several(
    models: Sequence[Model], label: str | None, objects: Mapping[str, str | None]
) -> list[str]:
    """Return a sentence if a label that was given for all objects (None: each has its
    own) is not what some of them are called, by the labels of their own.
    """
    if label is None or len(objects) < 2:
        return []

    def differ(own: str) -> bool:
        """Whether a model has classes for both labels, and none in common."""
        for model in models:
            try:
                known = set(model.label_set(own).indices)
            except InputError:
                continue
            if not known & set(model.label_set(label).indices):
                return True
        return False

    others = [
        f"{name} (its own is {own!r})"
        for name, own in objects.items()
        if own and differ(own)
    ]
    if not others:
        return []
    return [
        f"The label {label!r} is taken as the right label for every object, also for "
        f"{', '.join(others)}; "
        "without a label, each object has its own."
    ]


# ---------------------------------------------------------------------------------------------------------------------
# What a search maximises, over which domain, and what `printable` takes from it: how
# rough colours are, and how far from ink (Sharif et al. 2016, *Accessorize to a Crime*,
# sections 5.2.2 and 5.2.3). Theirs are sums over pixels, and a product of distances to
# all printable colours; these are means, and the distance to the nearest, which is zero
# at the same colours.


def domain_of(
    controls: Sequence[Control], start: Tensor | None = None, **more: Any
) -> Domain:
    """Return where a search over some controls may look: the budgets of all their
    groups, in the order of u, from `start` (d,) or the controls' own, which leaves the
    scene as it is; with `more` fields of `Domain`.
    """
    blocks = tuple(
        Block(
            group.size,
            group.budget.norm,
            group.budget.epsilon,  # type: ignore[arg-type]
            periodic=group.periodic,
            name=f"{control.name}.{group.parameter}",
            options=group.options,
        )
        for control in controls
        for group in control.groups
    )
    if start is None:
        start = (
            torch.cat([control.start for control in controls])
            if controls
            else torch.zeros(0)
        )
    return Domain(start, blocks, **more)


class Named(Mapping[str, Tensor]):
    """Tensors (N, ...) of N configurations by name; a message says `what` a name stands
    for that is none.
    """

    def __init__(self, what: str, each: Sequence[Mapping[str, Tensor]]) -> None:
        self._what = what
        self._each = each

    def __getitem__(self, name: str) -> Tensor:
        if name not in self:  # also of `get`
            raise UnknownNameError(self._what, name, self._each[0])
        return torch.stack([tensors[name] for tensors in self._each])

    def __contains__(self, name: object) -> bool:
        return name in self._each[0]

    def __iter__(self) -> Iterator[str]:
        return iter(self._each[0])

    def __len__(self) -> int:
        return len(self._each[0])


class ConfigurationInputs:
    """Gives what is asked for at N configurations (d,) of the whole space, which differ
    in nothing that is searched; `used` says whether anything was. The searched controls
    come first there.
    """

    def __init__(self, space: Space, searched: Space, wholes: Sequence[Tensor]) -> None:
        self._space = space
        self._searched = searched
        self._wholes = wholes
        self.used = False

    def __call__(self, name: str) -> Any:
        """Return what an objective asks for by name: "u", (N, d) of the searched
        controls; "texture", (N, h, w, 3) display-referred sRGB in [0, 1], the searched
        colours of the control that has some, or (N, h, w, 4) with 1 where they are
        searched and 0 elsewhere; "textures", the same by control, where several have
        some; "inputs", the scene inputs by name; "configuration", the numbers by
        parameter.
        """
        self.used = True
        if name == "inputs":
            return Named(
                "input of the scene",
                [self._space.inputs(whole) for whole in self._wholes],
            )
        if name == "configuration":
            return Named(
                "number of the configuration",
                [self._space.numbers(whole) for whole in self._wholes],
            )
        u = self._wholes[0][: len(self._searched.start)]
        if name == "u":
            return u.expand(len(self._wholes), *u.shape)
        printed = self._searched.printed(u)
        if name == "textures":
            return Named(
                "control whose colours are searched:", [printed] * len(self._wholes)
            )
        if len(printed) != 1:
            got = (
                ", ".join(
                    printed or (control.name for control in self._searched.controls)
                )
                or "nothing"
            )
            instead = (
                "ask for `textures`, which has them by name"
                if printed
                else "add `texture` or `patch`"
            )
            raise InputError(
                "objective: it asks for `texture`, so it needs one control whose "
                f"colours are searched, got {got}; "
                f"{instead}"
            )
        (colors,) = printed.values()
        return colors.expand(len(self._wholes), *colors.shape)


LOW = 0.1
HIGH = 0.9
STEP = 0.2
"""The printable colours: all 125 of which each channel is 0.1, 0.3, 0.5, 0.7 or 0.9 in
sRGB. No printer was measured: that ink on paper reaches neither the black, nor the
white, nor the pure colours of a screen is all that they say.
"""
# of either term, in the objective's unit (logits for a margin) per unit of sRGB
WEIGHT = 10.0
LEAST = 2.0**-40  # shortest step in sRGB that has a gradient


def variation(colors: Tensor) -> Tensor:
    """Return the mean length of the step from a pixel (h, w, 3) to its right and lower
    neighbours, by channel; of a picture (h, w, 4) only between pixels that its last
    channel has.
    """
    colors, there = colors[..., :3], colors[..., 3:]
    right = colors.diff(dim=1)
    down = colors.diff(dim=0)
    if there.shape[-1]:
        right = right * there[:, 1:]
        down = down * there[1:]
    squared = F.pad(right.square(), (0, 0, 0, 1)) + F.pad(
        down.square(), (0, 0, 0, 0, 0, 1)
    )
    length = squared.clamp(min=LEAST**2).sqrt() - LEAST
    return length[there[..., 0] > 0.0].mean() if there.shape[-1] else length.mean()


def off_print(colors: Tensor, palette: Tensor | None = None) -> Tensor:
    """Return the mean Euclidean distance in sRGB of pixels (h, w, 3) from the nearest
    printable colour, of a palette (P, 3) where one is given; of a picture (h, w, 4) of
    those that its last channel has.
    """
    colors = (
        colors if colors.shape[-1] == 3 else colors[colors[..., 3] > 0][:, None, :3]
    )
    if palette is None:
        nearest = (LOW + STEP * ((colors.detach() - LOW) / STEP).round()).clamp(
            LOW, HIGH
        )
    else:
        palette = palette.to(colors)
        nearest = palette[
            torch.cdist(colors.detach().reshape(-1, 3), palette).argmin(dim=1)
        ].reshape(colors.shape)
    distance: Tensor = torch.linalg.vector_norm(colors - nearest, dim=2).mean()
    return distance


def _terms(space: Space, u: Tensor) -> tuple[Tensor, Tensor]:
    printed = list(space.printed(u).values())
    if not printed:
        raise InputError(
            "printable: expected a search over the colours of a texture or a patch, "
            "got "
            f"{', '.join(control.name for control in space.controls)}; add `texture` "
            "or `patch`, or leave it out"
        )
    return torch.stack(list(map(variation, printed))).sum(), torch.stack(
        list(map(off_print, printed))
    ).sum()


def print_terms(space: Space, u: Tensor) -> PrintTerms:
    with torch.no_grad():
        rough, off = _terms(space, u)
    return PrintTerms(variation=float(rough), off_print=float(off))


def penalised(found: Evaluation, space: Space, u: Tensor) -> Evaluation:
    """Return an evaluation of u whose objective is less by both weighted terms, and its
    derivative by theirs.
    """
    at = u.detach().clone().requires_grad_()
    with torch.enable_grad():
        penalty = WEIGHT * torch.stack(_terms(space, at)).sum()
        (slope,) = torch.autograd.grad(penalty, at)
    derivative = None if found.gradient is None else found.gradient - slope
    return replace(
        found, objective=found.objective - float(penalty.detach()), gradient=derivative
    )


AnyObjective = str | Callable[..., Tensor]

Way = Literal["mean", "worst"]

# samples a pixel of the clean picture that an objective compares features with
CLEAN_SPP = 64


def task_for(task: Task, model: Model) -> Task:
    """Return the task, or that of several models where the model is an ensemble of
    them.
    """
    if isinstance(task, Together) or not isinstance(model.module, Ensemble):
        return task
    return Together(parts=(task,) * len(model.module.models))


def objective_for(
    wanted: AnyObjective,
    task: Task,
    model: Model,
    renderer: Renderer,
    seed: int,
    ensemble: Way | None = None,
) -> tuple[Objective, str]:
    """Return what is maximised, and what there is to say about it; one of features is
    shown the clean picture first. The objectives of several models are put together as
    `ensemble` says; without, their mean, or of several tasks, whose units differ, the
    least.
    """
    kind = OBJECTIVE_KINDS.get(wanted) if isinstance(wanted, str) else None
    of_features = kind is not None and kind.needs_features
    if isinstance(task, Together):
        if of_features:
            raise InputError(
                f"objective: {wanted} compares the features of one model; "
                "take another for `ensemble`"
            )
        own = wanted == Together.objective
        each = [
            get_objective(part.objective if own else wanted, part)
            for part in task.tasks
        ]
        return of_ensemble(each, ensemble or ("worst" if own else "mean")), ""
    if not of_features:
        return get_objective(wanted, task), ""
    # otherwise they are what the model returns
    features = features_of(model) if task.reads_logits else None
    with torch.no_grad():
        clean = renderer(renderer.start, seed=seed, spp=CLEAN_SPP)
    note = "" if features is None or features.penultimate else features.source
    return get_objective(wanted, task, features=features or model, clean=clean), note


def of_ensemble(objectives: Sequence[Objective], way: Way) -> Objective:
    """Return the objective of several models: the mean of theirs, or the least of them.

    With "worst" the model that is hardest to mislead is the one that counts, so that
    the maximum is over 0 only where every model is misled. The mean may be large
    because of one model; its gradient reaches all of them.
    """

    def objective(
        output: Sequence[Outputs],
        images: Tensor,
        truth: tuple[Any, ...],
        more: More = nothing_more,
        /,
    ) -> Tensor:
        each = zip(objectives, of_each(output), truth, strict=True)
        values = torch.stack(
            [value_of(own, images, right, more) for value_of, own, right in each]
        )
        return values.mean(dim=0) if way == "mean" else values.amin(dim=0)

    return objective
