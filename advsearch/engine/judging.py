"""Judgements of images: tasks, user metrics, print terms, and objectives.

A task compares the output of a model with the ground truth of the scene. A metric is a
user function whose values are stored with every image.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from operator import attrgetter
from types import MappingProxyType
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.attacks import Block, Domain, Evaluation, Objective, get_objective
from advsearch.attacks.objectives import (
    OBJECTIVE_KINDS,
    ReadInput,
    reject_inputs,
    truth_to_labels,
)
from advsearch.controls import Space
from advsearch.controls.base import Control
from advsearch.copies import copy_value
from advsearch.engine.loading import Scene
from advsearch.engine.rendering import render
from advsearch.errors import InputError, UnknownNameError
from advsearch.files import JsonObject
from advsearch.models import Model
from advsearch.models.features import features_of
from advsearch.options import Value, check_takes_arguments
from advsearch.report.wording import format_image_prediction
from advsearch.runs.export import LEADING_COLUMNS, TRAILING_COLUMNS
from advsearch.runs.results import PrintTerms
from advsearch.scene.description import OBJECT
from advsearch.scene.formation import Surfaces
from advsearch.scene.gradients import Group
from advsearch.scene.renderer import Renderer
from advsearch.scene.things import ALL_THINGS
from advsearch.tasks import Facts, Judgement, Task
from advsearch.tasks.base import Output, Prediction, Truth, mean
from advsearch.tasks.together import Ensemble, EnsembleTask, Outputs, regroup_by_model
from advsearch.trust.code import check_import, current_directory_importable

Metric = Callable[[Tensor, Any, Any], Any]
"""f(image, output, truth), which returns a number, or numbers by name.

Where a single class is right, `truth` is its index, a tensor without axes.
"""

Metrics = Mapping[str, Metric]

# module of the script that runs; every other process has it under another name
MAIN = "__main__"


def metrics_to_settings(metrics: Mapping[str, str | Metric]) -> dict[str, str]:
    """Return metrics by name as a file states them: "package.module:function".

    A function that cannot be imported by such a text, as a lambda, is stated by its
    bare name.

    Args:
        metrics: functions of (image, output, truth) by name, or texts
            "package.module:function".

    Raises:
        InputError: the argument is no mapping of functions, a function has other
            parameters, or a name is that of a column of rows.
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
        _check_metric_name(name)
        settings[name] = _metric_to_setting(name, function)
    return settings


def _check_metric_name(name: str) -> None:
    """Raise InputError if a name is that of a column of rows, or empty."""
    is_column = name in (*LEADING_COLUMNS, *TRAILING_COLUMNS)
    if is_column or not name:  # an empty name gets the same message
        raise InputError(
            f"metrics: {name!r} is a column that rows have already; choose another name"
        )


def _metric_to_setting(name: str, function: str | Metric) -> str:
    """Return the text by which a file states a metric; a text stays as it is."""
    if isinstance(function, str):
        return function
    _check_metric_is_callable(name, function)
    check_takes_arguments(f"metrics: {name}", function, "image", "output", "truth")
    return _import_name(function)


def _check_metric_is_callable(name: str, function: object) -> None:
    """Raise InputError if a metric is no function."""
    if not callable(function):
        raise InputError(
            f"metrics: {name}: expected a function of (image, output, "
            f"truth), got {function!r:.80}"
        )


def _import_name(function: Metric) -> str:
    """Return "module:qualified.name" of a function, or its bare name.

    The bare name stands for a function that its module does not have under that name,
    such as a lambda or a partial.
    """
    module_name = str(getattr(function, "__module__", None))
    qualified_name = str(getattr(function, "__qualname__", None))
    # Follow the names as an import would, and see whether that leads to the function.
    imported: Any = sys.modules.get(module_name)
    for attribute in qualified_name.split("."):
        imported = getattr(imported, attribute, None)
    if imported is function:
        return f"{module_name}:{qualified_name}"
    return str(getattr(function, "__name__", type(function).__name__))


def list_session_only_metrics(settings: Mapping[str, str]) -> list[str]:
    """List the metrics, by name, that exist in this Python session only."""
    return [
        name
        for name, import_name in settings.items()
        if ":" not in import_name or import_name.startswith(f"{MAIN}:")
    ]


def check_metrics_importable(settings: Mapping[str, str]) -> None:
    """Raise InputError for the first metric that workers could not import."""
    for name in list_session_only_metrics(settings):
        # of "package.module:function", or a bare name already
        _, _, bare_name = settings[name].rpartition(":")
        raise InputError(
            f"metrics: {name}: workers import a metric by its name, and {bare_name} "
            "has none that they could; write it as a function of a module, or leave "
            "`workers` and `cluster` out"
        )


def load_metrics(
    settings: Mapping[str, str],
    python_functions: Mapping[str, str | Metric] | None = None,
) -> Metrics:
    """Return the functions of metrics by name.

    Args:
        settings: for each metric a text "package.module:function", as
            `metrics_to_settings` returns it.
        python_functions: the metrics as the caller passed them, by name. Functions
            among these are not imported.

    Raises:
        InputError: a function cannot be imported, or the imported object is no
            function.
    """
    loaded: dict[str, Any] = {}
    for name, import_name in settings.items():
        function: Any = (python_functions or {}).get(name)
        # the caller may have passed a text instead
        if not callable(function):
            function = _import_metric(name, import_name)
        loaded[name] = function
    return loaded


def _import_metric(name: str, import_name: str) -> Any:
    """Import a metric function.

    Args:
        name: name of the metric, for messages.
        import_name: "package.module:function".

    Raises:
        InputError: the text has another form, the import fails, or what it imports is
            no function.
    """
    module, colon, attribute = import_name.partition(":")
    if not colon or not attribute:
        raise InputError(
            f"metrics: {name}: expected package.module:function, got {import_name!r}"
        )
    check_import(import_name)
    try:
        with current_directory_importable():
            function = attrgetter(attribute)(import_module(module))
    except Exception as error:  # the user's code may raise anything
        raise InputError(
            f"metrics: {name}: {import_name} cannot be imported "
            f"({type(error).__name__}: {error}); a module is looked for "
            f"on the Python path and in {os.getcwd()}"
        ) from error
    _check_metric_is_callable(name, function)
    return function


def judge_images(
    task: Task,
    output: Output,
    images: Tensor,
    truths: Sequence[Truth],
    metrics: Metrics = MappingProxyType({}),
) -> list[Judgement]:
    """Return the judgement of each image, with the values of the user's metrics.

    This is the only place where a run judges images.

    Args:
        task: judges the output.
        output: output of the model for all N images.
        images: (N, H, W, 3) sRGB in [0, 1].
        truths: what is true of each of the N images, or one truth that holds for all.
        metrics: user functions by name.
    """
    with torch.no_grad():
        if len(truths) == 1:
            (common_truth,) = truths
            judgements = task.judge(output, common_truth)
            truths = [common_truth] * len(images)  # for the metrics
        else:
            judgements = _judge_each_by_truth(task, output, truths)
    if not metrics:
        return judgements
    return [
        add_metrics(
            judgements[index], metrics, images[index], output[index : index + 1], truth
        )
        for index, truth in enumerate(truths)
    ]


def _judge_each_by_truth(
    task: Task, output: Output, truths: Sequence[Truth]
) -> list[Judgement]:
    """Return the judgement of each image of a batch by its truth.

    A task judges a batch by one truth, so that each image is its own batch.
    """
    return [
        task.judge(output[index : index + 1], truth)[0]
        for index, truth in enumerate(truths)
    ]


def add_visible_things(judgement: Judgement, things: JsonObject | None) -> Judgement:
    """Return a judgement whose payload states what the image shows of each thing.

    Where the task itself has stated something of a thing, that is kept. The judgement
    of an output that is NaN stays as it is.

    Args:
        judgement: judgement of the image.
        things: box, pixel count and more by thing, from `find_visible_things`, also for
            things that are hidden; None if the scene has only the object.
    """
    if things is None or judgement.is_non_finite:
        return judgement
    payload = judgement.payload if isinstance(judgement.payload, dict) else {}
    stated_by_task: Any = payload.get("things", {})
    merged: Any = {
        name: {**visible, **stated_by_task.get(name, {})}  # type: ignore[dict-item]
        for name, visible in things.items()
    }
    return replace(judgement, payload={**payload, "things": merged})


def add_metrics(
    judgement: Judgement, metrics: Metrics, image: Tensor, output: Output, truth: Truth
) -> Judgement:
    """Return a judgement with the values of the user's metrics.

    Metrics get copies of image, output and truth, so that a function that changes its
    arguments cannot change the run.

    Args:
        judgement: judgement of the image.
        metrics: functions by name.
        image: (H, W, 3) sRGB in [0, 1].
        output: output of the model, for a batch of this one image.
        truth: what is true of the image; a metric gets it in the form in which an
            objective gets it, such as the index of the right class.

    Raises:
        InputError: a metric returns no number and no mapping of numbers.
    """
    image_output, image_truth = _unbatch(output, truth)
    with torch.no_grad():
        # what the metrics returned, with an entry for each item of a mapping
        returned = dict[str, Any]()
        for name, metric in metrics.items():
            result = metric(*copy_value((image.detach(), image_output, image_truth)))
            returned |= _flatten_metric_result(name, result)
        values = {
            name: _to_metric_value(name, result) for name, result in returned.items()
        }
    return replace(judgement, metrics=values)


def _flatten_metric_result(name: str, result: Any) -> dict[str, Any]:
    """Return what a metric returned by name, with an entry for each item of a mapping."""
    if isinstance(result, Mapping):
        return {f"{name}.{key}": value for key, value in result.items()}
    return {name: result}


def _to_metric_value(name: str, result: Any) -> float | None:
    """Return one value that a metric returned, as a number.

    None stands for NaN and infinity, which JSON does not have.

    Args:
        name: name of the metric, for the message.
        result: what it returned, or a value of the dict that it returned.

    Raises:
        InputError: it is no number.
    """
    try:
        value = float(result)
    except (TypeError, ValueError, RuntimeError):
        # torch raises RuntimeError for a tensor of several values
        raise InputError(
            f"metrics: {name}: expected a number, or a dict from names to "
            f"numbers, got {result!r:.80}"
        ) from None
    return value if math.isfinite(value) else None


def _unbatch(output: Output, truth: Truth) -> tuple[Any, Any]:
    """Return output and truth of the only image of a batch, without the batch axis.

    Metrics are called with these. For an ensemble both are tuples with one item for
    each model. The output for an image is then a sequence, with the output of each
    model as a batch of one.
    """
    image_output = output[0]
    is_ensemble = isinstance(image_output, (tuple, list))
    if is_ensemble:
        return _unbatch_each_model(image_output, truth)
    labels = truth_to_labels(truth, output, count=1)
    # a single label is a tensor (1,); any other truth stays as it is
    image_truth = labels[0] if isinstance(labels, Tensor) else labels
    return image_output, image_truth


def _unbatch_each_model(
    outputs: Sequence[Output], truths: Sequence[Truth]
) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Return outputs and truths of the models of an ensemble, without the batch axis."""
    pairs = [
        _unbatch(model_output, model_truth)
        for model_output, model_truth in zip(outputs, truths, strict=True)
    ]
    image_outputs = tuple(model_output for model_output, _ in pairs)
    image_truths = tuple(model_truth for _, model_truth in pairs)
    return image_outputs, image_truths


def mean_metrics(judgements: Sequence[Judgement]) -> dict[str, float | None] | None:
    """Return the mean of each metric over the images for which it is a number.

    The mean is None if it is a number for no image; without any metric the result is
    None.
    """
    values_by_name: dict[str, list[float]] = {}
    for judgement in judgements:
        for name, value in (judgement.metrics or {}).items():
            values = values_by_name.setdefault(name, [])
            if value is not None:
                values.append(value)
    means = {
        name: mean(values) if values else None
        for name, values in values_by_name.items()
    }
    return means or None


CALIBRATION_SPP = 16  # samples per pixel of the clean image that calibrates a task

DescribeConfiguration = Callable[[], Mapping[str, Value]]
"""Describes the configuration in named values, when it is called."""

RenderSurfaces = Callable[[], Surfaces]
"""Renders what the camera sees, when it is called."""


def calibrate_task(
    task: Task,
    model: Model,
    scenes: Sequence[Scene],
    label: str | None,
    judge: str,
    image_settings: Mapping[str, Any],
) -> Task:
    """Return the task, calibrated by what its model predicts on clean images.

    A task calibrates if the model's output can be read in several ways: a depth model,
    for example, may return depths or their inverse. Scenes are rendered in turn until
    the right reading is clear. Any other task is returned as it is.

    Args:
        task: task of the model.
        model: model that predicts.
        scenes: scenes in order.
        label: the right label; None for the own label of each object.
        judge: name of the thing that is judged: "object", "all", or a thing's name.
        image_settings: keywords of `render` for the images that the model sees, see
            `SceneConfig.image_settings`.

    Raises:
        InputError: the predictions stay ambiguous.
    """
    if not task.calibrates:
        return task
    # one thing is enough to see how predictions are to be read
    judged_thing = OBJECT if judge == ALL_THINGS else judge
    for scene in scenes:
        rendering = render(
            scene,
            model,
            task=task,
            label=label,
            judge=judged_thing,
            spp=CALIBRATION_SPP,
            **image_settings,
        )
        view = rendering.views[0]  # `render` made one, as `around` was not given
        # the task now has the evidence of all scenes so far
        task = task.after_calibration(view.output, view.truth)
        if not task.ambiguity_message:
            return task
    raise InputError(f"model {model.name}: {task.ambiguity_message}")


def _get_unique_label(model: Model, prediction: Prediction) -> str:
    """Return a label that names the predicted class and no other, such as "#504".

    It is the name of the class if only this class has it, else its index.
    """
    # `label_set` raises for a name that no class has
    with suppress(InputError):
        if model.label_set(prediction.label).indices == (prediction.index,):
            return prediction.label
    return f"#{prediction.index}"


def check_truth(
    task: Task,
    model: Model,
    scene: Scene,
    facts: Facts,
    image_settings: Mapping[str, Any],
) -> None:
    """Check that the task can derive the truth of a scene, before a run is prepared.

    Args:
        task: task of the model.
        model: model that predicts.
        scene: the clean scene.
        facts: names, labels and measures of the scene that the task judges by.
        image_settings: keywords of `render` for the images that the model sees.

    Raises:
        InputError: it cannot. If the user stated no label, the message has the model's
            predictions for a clean image, and suggests one of them.
    """
    try:
        # If all things are judged, `facts_of_thing` has the facts of each of them.
        # Otherwise it is empty, and `facts` are those of the judged thing.
        judged_facts = list(facts.facts_of_thing.values()) or [facts]
        for facts_of_thing in judged_facts:
            task.check(facts_of_thing)
    except InputError as error:
        # If the user stated a label, it is wrong, and the message of the task says why.
        if facts.label is not None:
            raise
        rendering = render(
            scene, model, task=task, spp=CALIBRATION_SPP, **image_settings
        )
        predictions = rendering.views[0].predictions
        raise _make_label_error(error, model, task, predictions) from None


def _make_label_error(
    error: InputError, model: Model, task: Task, predictions: Sequence[Prediction]
) -> InputError:
    """Return an error that suggests a label: the most probable of the predictions."""
    prediction_texts = ", ".join(
        format_image_prediction(
            task.name, replace(prediction, label=repr(prediction.label))
        )
        for prediction in predictions
    )
    suggested_label = _get_unique_label(model, predictions[0])
    return InputError(
        f"{error}; model {model.name} calls a clean picture of it "
        f"{prediction_texts}; name what is right, such as "
        f'`label="{suggested_label}"`'
    )


def find_label_warnings(
    models: Sequence[Model], label: str | None, objects: Mapping[str, str | None]
) -> list[str]:
    """Return a warning if one label is stated for objects of different classes.

    With objects "mug" and "car", `label="mug"` would count the car as a mug.

    Args:
        models: models with names of classes.
        label: label that the user stated for all objects; None if there is none, so
            that each object has its own.
        objects: own label of each object, by the object's name.
    """
    if label is None or len(objects) < 2:
        return []
    differing = [
        f"{name} (its own is {object_label!r})"
        for name, object_label in objects.items()
        if object_label and _has_disjoint_classes(models, object_label, label)
    ]
    if not differing:
        return []
    return [
        f"The label {label!r} is taken as the right label for every object, also for "
        f"{', '.join(differing)}; without a label, each object has its own."
    ]


def _has_disjoint_classes(models: Sequence[Model], first: str, second: str) -> bool:
    """Return whether two labels name different classes of some model.

    They do if the model has classes for both labels, and no class has both.

    Args:
        models: models with names of classes.
        first: an object's own label. A model need not have a class for it; such a model
            is skipped.
        second: the label that the user stated, for which every model has to have a
            class.

    Raises:
        InputError: a model has no class for `second`.
    """
    for model in models:
        try:
            first_classes = set(model.label_set(first).indices)
        except InputError:
            continue
        second_classes = set(model.label_set(second).indices)
        if not first_classes & second_classes:
            return True
    return False


# ---- domain and objective
# The domain and the objective of a search, and the terms that `printable` subtracts
# from the objective: the variation of colors, and their distance from printable ones.
# Both are after Sharif et al. 2016, *Accessorize to a Crime*, sections 5.2.2 and 5.2.3.
# There they are sums over pixels, and the distance is a product over all printable
# colors. Here they are means, and the distance is that to the nearest printable color,
# which is zero at the same colors.


def make_domain(
    controls: Sequence[Control], start: Tensor | None = None, **more: Any
) -> Domain:
    """Return the domain of a search over some controls: a block for each group.

    Args:
        controls: controls in the order of u.
        start: (d,) where the search starts; None for the start of the controls, which
            leaves the scene unchanged.
        **more: other fields of `Domain`, such as `gradient_cost`.
    """
    blocks = [
        _make_block(control.name, group)
        for control in controls
        for group in control.groups
    ]
    if start is None:
        starts = [control.start for control in controls]
        start = torch.cat(starts) if starts else torch.zeros(0)
    return Domain(start, tuple(blocks), **more)


def _make_block(control_name: str, group: Group) -> Block:
    """Return the block of a domain for a group of a control's coordinates."""
    return Block(
        group.size,
        group.budget.norm,  # type: ignore[arg-type]
        group.budget.epsilon,
        periodic=group.periodic,
        name=f"{control_name}.{group.parameter}",
        n_options=group.options,  # number of options; 0 for a number
    )


class StackedTensors(Mapping[str, Tensor]):
    """Tensors of N configurations by name, stacked to (N, ...) when one is read."""

    def __init__(
        self, kind: str, tensors_of_configuration: Sequence[Mapping[str, Tensor]]
    ) -> None:
        """Store the tensors of each configuration.

        Args:
            kind: kind of the names, such as "input of the scene", for the message about
                an unknown one.
            tensors_of_configuration: for each of the N configurations, tensors by name.
        """
        self._kind = kind
        self._tensors_of_configuration = tensors_of_configuration

    def __getitem__(self, name: str) -> Tensor:
        """Return the tensors with a name, stacked to (N, ...)."""
        # Not a KeyError, which `Mapping.get` would turn into None: an unknown name is
        # an error there, too.
        if name not in self:
            raise UnknownNameError(self._kind, name, self._tensors_of_configuration[0])
        return torch.stack(
            [tensors[name] for tensors in self._tensors_of_configuration]
        )

    def __contains__(self, name: object) -> bool:
        return name in self._tensors_of_configuration[0]

    def __iter__(self) -> Iterator[str]:
        return iter(self._tensors_of_configuration[0])

    def __len__(self) -> int:
        return len(self._tensors_of_configuration[0])


class ConfigurationInputs:
    """The further inputs that an objective may read, at N configurations.

    An objective that reads some depends on the configuration not only through the
    image. Then its gradient has a second part, which the caller computes if `used` is
    set.

    Attributes:
        used: whether the objective has read an input.

    Args:
        space: all controls; those that are searched come first.
        searched: the controls that are searched.
        full_configurations: N configurations (d,) of `space`, with the same searched
            coordinates.
    """

    def __init__(
        self, space: Space, searched: Space, full_configurations: Sequence[Tensor]
    ) -> None:
        self._space = space
        self._searched = searched
        self._configurations = full_configurations
        self.used = False

    def __call__(self, name: str) -> Any:
        """Return an input of the objective by its name, for all N configurations.

        - "u": (N, d) of the searched controls;
        - "texture": (N, h, w, 3) display-referred sRGB in [0, 1], the searched colors
          of the only control that has some, or (N, h, w, 4) with 1 where they are
          searched and 0 elsewhere;
        - "textures": the same by control, where several have some;
        - "inputs": the scene inputs by name;
        - "configuration": the values of parameters by name.

        Raises:
            InputError: "texture", and not exactly one control has searched colors.
        """
        self.used = True  # the objective depends on more than the image
        if name == "inputs":
            inputs = [self._space.inputs(u) for u in self._configurations]
            return StackedTensors("input of the scene", inputs)
        if name == "configuration":
            values = [self._space.get_numeric_values(u) for u in self._configurations]
            return StackedTensors("number of the configuration", values)
        n_configurations = len(self._configurations)
        searched_u = self._searched_u
        if name == "u":
            return searched_u.expand(n_configurations, *searched_u.shape)
        textures = self._searched.get_printable_colors(searched_u)
        if name == "textures":
            return StackedTensors(
                "control whose colours are searched:", [textures] * n_configurations
            )
        texture = self._get_single_texture(textures)
        return texture.expand(n_configurations, *texture.shape)

    @property
    def _searched_u(self) -> Tensor:
        """The searched coordinates (d,), which come first in each configuration.

        They are the same in all configurations, so that those of the first are taken.
        """
        return self._configurations[0][: len(self._searched.start)]

    def _get_single_texture(self, textures: Mapping[str, Tensor]) -> Tensor:
        """Return the only texture; raise InputError if there are none or several."""
        if len(textures) != 1:
            raise self._make_texture_error(textures)
        (texture,) = textures.values()
        return texture

    def _make_texture_error(self, textures: Mapping[str, Tensor]) -> InputError:
        """Return the error of a "texture" where there are none or several."""
        if textures:
            got = ", ".join(textures)
            instead = "ask for `textures`, which has them by name"
        else:
            got = ", ".join(control.name for control in self._searched.controls)
            instead = "add `texture` or `patch`"
        return InputError(
            "objective: it asks for `texture`, so it needs one control whose "
            f"colours are searched, got {got or 'nothing'}; {instead}"
        )


MIN_PRINTABLE = 0.1
MAX_PRINTABLE = 0.9
PRINTABLE_STEP = 0.2
"""The printable colors: all 125 whose channels are 0.1, 0.3, 0.5, 0.7 or 0.9 in sRGB.

No printer was measured: the colors only express that ink on paper reaches neither the
black, nor the white, nor the pure colors of a screen.
"""
# of each print term, in units of the objective (logits for a margin) per unit of sRGB
PRINT_WEIGHT = 10.0
MIN_COLOR_STEP = 2.0**-40  # shortest step in sRGB that has a gradient


def mean_variation(colors: Tensor) -> Tensor:
    """Return the mean length of the step from a pixel to its right and lower neighbors.

    Args:
        colors: (h, w, 3) sRGB; or (h, w, 4), of which only steps between pixels with a
            last channel over 0 count.
    """
    is_masked = colors.shape[-1] == 4
    mask = colors[..., 3:]
    colors = colors[..., :3]
    right = colors.diff(dim=1)
    down = colors.diff(dim=0)
    if is_masked:
        # the step's first pixel is masked at the end, its second one here
        right = right * mask[:, 1:]
        down = down * mask[1:]
    length = _compute_step_lengths(right, down)
    if is_masked:
        length = length[mask[..., 0] > 0.0]
    return length.mean()


def _compute_step_lengths(right: Tensor, down: Tensor) -> Tensor:
    """Return the length (h, w) of each pixel's steps to its right and lower neighbors.

    Args:
        right: (h, w - 1, 3) differences to the right neighbors.
        down: (h - 1, w, 3) differences to the lower neighbors.
    """
    # Zeros are added for the last column and the last row, which have no neighbor.
    # `pad` takes the zeros before and after, from the last axis (color) to the first.
    squared_right = F.pad(right.square(), (0, 0, 0, 1))
    squared_down = F.pad(down.square(), (0, 0, 0, 0, 0, 1))
    squared = squared_right + squared_down
    # Clamped, since the square root has no derivative at 0; then minus the smallest
    # length, so that the result is 0 for an even color.
    return squared.clamp(min=MIN_COLOR_STEP**2).sqrt() - MIN_COLOR_STEP


def printable_distance(colors: Tensor, palette: Tensor | None = None) -> Tensor:
    """Return the mean Euclidean distance of pixels from the nearest printable color.

    The derivative moves each pixel towards its nearest color.

    Args:
        colors: (h, w, 3) sRGB; or (h, w, 4), of which only pixels with a last channel
            over 0 count.
        palette: (P, 3) sRGB of printable colors; None for the grid of 125 colors.
    """
    is_masked = colors.shape[-1] != 3
    if is_masked:
        # The N pixels that count, as an image (N, 1, 3) of one column.
        colors = colors[colors[..., 3] > 0][:, None, :3]
    # The choice of the nearest color has no derivative.
    fixed_colors = colors.detach()
    if palette is None:
        nearest = _find_nearest_in_grid(fixed_colors)
    else:
        nearest = _find_nearest_in_palette(fixed_colors, palette.to(colors))
    distance: Tensor = torch.linalg.vector_norm(colors - nearest, dim=2).mean()
    return distance


def _find_nearest_in_grid(colors: Tensor) -> Tensor:
    """Return the nearest of the 125 printable colors for each of (h, w, 3) pixels."""
    # each channel is rounded to a multiple of the step
    n_steps = ((colors - MIN_PRINTABLE) / PRINTABLE_STEP).round()
    nearest = MIN_PRINTABLE + PRINTABLE_STEP * n_steps
    return nearest.clamp(MIN_PRINTABLE, MAX_PRINTABLE)


def _find_nearest_in_palette(colors: Tensor, palette: Tensor) -> Tensor:
    """Return the nearest color of a palette (P, 3) for each of (h, w, 3) pixels."""
    palette_index = torch.cdist(colors.reshape(-1, 3), palette).argmin(dim=1)
    return palette[palette_index].reshape(colors.shape)


def _compute_print_terms(space: Space, u: Tensor) -> tuple[Tensor, Tensor]:
    """Return how rough the searched colors are, and how far from printable ones.

    Both are sums over the controls with searched colors, such as `texture`.

    Args:
        space: the searched controls.
        u: (d,) the configuration.

    Raises:
        InputError: no control has searched colors.
    """
    textures = list(space.get_printable_colors(u).values())
    if not textures:
        control_names = ", ".join(control.name for control in space.controls)
        raise InputError(
            "printable: expected a search over the colours of a texture or a patch, "
            f"got {control_names}; add `texture` or `patch`, or leave it out"
        )
    variations = [mean_variation(texture) for texture in textures]
    distances = [printable_distance(texture) for texture in textures]
    return torch.stack(variations).sum(), torch.stack(distances).sum()


def measure_print_terms(space: Space, u: Tensor) -> PrintTerms:
    """Measure how printable the searched colors of a configuration (d,) are."""
    with torch.no_grad():
        total_variation, total_distance = _compute_print_terms(space, u)
    return PrintTerms(variation=float(total_variation), off_print=float(total_distance))


def subtract_print_penalty(
    evaluation: Evaluation, space: Space, u: Tensor
) -> Evaluation:
    """Return an evaluation whose objective prefers colors that can be printed.

    Both print terms, times `PRINT_WEIGHT`, are subtracted from the objective, and their
    derivative from the gradient.

    Args:
        evaluation: evaluation of u.
        space: the searched controls.
        u: (d,) the configuration.
    """
    variable_u = u.detach().clone().requires_grad_()
    with torch.enable_grad():
        print_terms = _compute_print_terms(space, variable_u)
        penalty = PRINT_WEIGHT * torch.stack(print_terms).sum()
        (penalty_gradient,) = torch.autograd.grad(penalty, variable_u)
    gradient = None
    if evaluation.gradient is not None:
        gradient = evaluation.gradient - penalty_gradient
    objective = evaluation.objective - float(penalty.detach())
    return replace(evaluation, objective=objective, gradient=gradient)


AnyObjective = str | Callable[..., Tensor]

EnsembleReduction = Literal["mean", "worst"]

# samples per pixel of the clean image that an objective compares features with
CLEAN_SPP = 64


def make_ensemble_task(task: Task, model: Model) -> Task:
    """Return the task of a model; for an ensemble, the joint task of its models."""
    if isinstance(task, EnsembleTask) or not isinstance(model.module, Ensemble):
        return task
    return EnsembleTask(parts=(task,) * len(model.module.models))


def make_objective(
    requested: AnyObjective,
    task: Task,
    model: Model,
    renderer: Renderer,
    seed: int,
    ensemble: EnsembleReduction | None = None,
) -> tuple[Objective, str]:
    """Return the function that a search maximizes, and a remark about it or "".

    Args:
        requested: name of an objective, or a function.
        task: task of the model.
        model: model whose output is evaluated.
        renderer: renders the clean image for an objective that compares features.
        seed: seed of the noise of that image.
        ensemble: how the objectives of several models become one, "mean" or "worst".
            None for their mean, or for the smallest if each model has the objective of
            its own task, since units of tasks differ.

    Raises:
        InputError: an objective of features, and several models.
    """
    kind = OBJECTIVE_KINDS.get(requested) if isinstance(requested, str) else None
    needs_features = kind is not None and kind.needs_features
    if isinstance(task, EnsembleTask):
        _check_needs_no_features(requested, needs_features)
        return _make_ensemble_objective(requested, task, ensemble), ""
    if not needs_features:
        return get_objective(requested, task), ""
    return _make_feature_objective(requested, task, model, renderer, seed)


def _check_needs_no_features(requested: AnyObjective, needs_features: bool) -> None:
    """Raise InputError if an objective of several models needs features of one."""
    if needs_features:
        raise InputError(
            f"objective: {requested} compares the features of one model; "
            "take another for `ensemble`"
        )


def _make_feature_objective(
    requested: AnyObjective, task: Task, model: Model, renderer: Renderer, seed: int
) -> tuple[Objective, str]:
    """Return an objective that compares features of an image with the clean image's.

    Args:
        requested: name of an objective that needs features.
        task: task of the model.
        model: model whose features are compared.
        renderer: renders the clean image.
        seed: seed of the noise of that image.

    Returns:
        The objective, and a remark. The remark states which features are compared if
        they are not those before the last layer; else it is "".
    """
    # Features are those before the last layer of the model. If the task reads no
    # logits, they are the output of the model. So the model itself is the function that
    # computes features.
    features = features_of(model) if task.reads_logits else None
    with torch.no_grad():
        clean_image = renderer(renderer.start, seed=seed, spp=CLEAN_SPP)
    remark = ""
    if features is not None and not features.penultimate:
        remark = features.source_description
    objective = get_objective(
        requested, task, features=features or model, clean=clean_image
    )
    return objective, remark


def _make_ensemble_objective(
    requested: AnyObjective, task: EnsembleTask, ensemble: EnsembleReduction | None
) -> Objective:
    """Return the objective of several models.

    Args:
        requested: name of an objective, or a function, for all models.
        task: joint task of the models.
        ensemble: "mean" or "worst" of the models' objectives; None for the default.
    """
    # `EnsembleTask.objective`, "each", is the default of such a task, and means that
    # each model has the objective of its own task.
    uses_task_objectives = requested == EnsembleTask.objective
    objectives = [
        get_objective(part.objective if uses_task_objectives else requested, part)
        for part in task.tasks
    ]
    reduction = ensemble
    if reduction is None:
        # A mean needs equal units, which the objectives of different tasks lack.
        reduction = "worst" if uses_task_objectives else "mean"
    return reduce_objectives(objectives, reduction)


def reduce_objectives(
    objectives: Sequence[Objective], reduction: EnsembleReduction
) -> Objective:
    """Return the objective of several models: the mean or the smallest of theirs.

    With "worst" it is the smallest: the model that is hardest to mislead counts, and
    the objective is over 0 only where every model is misled. The mean may be large
    because of one model, but its gradient reaches all of them. The returned function
    takes outputs of all models and a tuple of their truths.

    Args:
        objectives: objective of each model.
        reduction: "mean" or "worst".
    """
    return _ReducedObjective(objectives, reduction)


@dataclass(frozen=True, eq=False)
class _ReducedObjective:
    """The mean or the smallest of the objectives of several models.

    Attributes:
        objectives: objective of each model.
        reduction: "mean" or "worst".
    """

    objectives: Sequence[Objective]
    reduction: EnsembleReduction

    def __call__(
        self,
        output: Sequence[Outputs],
        images: Tensor,
        truth: tuple[Any, ...],
        more: ReadInput = reject_inputs,
        /,
    ) -> Tensor:
        """Return the objective (N,) of images (N, H, W, 3) for all models together."""
        outputs_of_models = regroup_by_model(output)
        values = [
            objective_of_model(output_of_model, images, truth_of_model, more)
            for objective_of_model, output_of_model, truth_of_model in zip(
                self.objectives, outputs_of_models, truth, strict=True
            )
        ]
        stacked = torch.stack(values)
        if self.reduction == "mean":
            return stacked.mean(dim=0)
        return stacked.amin(dim=0)
