"""Functions of the Python interface: `render`, `load_run` and `load_model`.

`render` renders images of a scene, with the predictions of a model. `load_run` loads
the result of a run from its folder. `load_model` loads a model, for a task by its name.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Collection, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import numpy as np
import torch
from torch import Tensor, nn

from advsearch import models
from advsearch.calls import with_checked_arguments
from advsearch.config import RenderConfig
from advsearch.engine import rendering
from advsearch.engine.naming import (
    check_run_settings,
    hold_process_lock,
    load_configured_scene,
    load_models,
    make_configured_controls,
)
from advsearch.engine.rendering import Rendering as Rendering
from advsearch.engine.rendering import check_image_path
from advsearch.errors import InputError
from advsearch.models import Model
from advsearch.progress import NullProgress, Progress, with_progress_option
from advsearch.questions.attack.carry_out import load_parts_of_run
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.attack.summary import AttackSummary
from advsearch.questions.sweep.result import SweepResult
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.runs.directory import ARTIFACTS, IMAGES, find_run
from advsearch.runs.files import read_png
from advsearch.runs.results import RenderResult, Result
from advsearch.runs.summary import read_configuration, read_result
from advsearch.scene.formation import parse_aovs
from advsearch.scene.importing.hdr import read_exr
from advsearch.tasks import AnyTask, make_task
from advsearch.trust.code import allow_code_in_settings, allow_code_of_call
from advsearch.trust.stored_files import LARGEST_FILE, read_bytes

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from advsearch.models.model import Read


@with_checked_arguments
def load_run(run: str | Path) -> AttackResult | SweepResult | Result:
    """Load the result of a run from its folder.

    It has the type that the function of the experiment returns, such as `AttackResult`
    or `SweepResult`. An attack of several objects, epsilons or models by the command
    line has a table as its result. `search` of a loaded attack is None; its steps are
    in `rows("search")`. Nothing is rendered, and the scene and the model are not loaded
    before `render` needs them.

    Args:
        run: name of the run, which stands for runs/NAME, or its folder.

    Raises:
        UnknownNameError: there is no such run.
        InputError: `run` is neither a name nor a folder.
        FileFormatError: the run has not ended, or its files are corrupt.
    """
    if not isinstance(run, (str, Path)):
        raise InputError(
            f"run: expected the name of a run or its folder, got {run!r:.80}"
        )
    path = find_run(run)
    result = read_result(path)
    if isinstance(result, AttackSummary):
        return _load_attack(result, path)
    if isinstance(result, SweepSummary):
        return SweepResult(result, path)
    return result


def _load_attack(summary: AttackSummary, path: Path) -> AttackResult:
    """Load the images and artifacts of an attack from the folder of its run.

    Args:
        summary: stored result of the attack.
        path: folder of the run.
    """
    clean = read_png(path / IMAGES / "clean.png")
    adversarial = read_png(path / IMAGES / "adversarial.png")
    artifacts = _load_artifacts(path)
    return AttackResult(
        summary=summary,
        run=path,
        u=torch.from_numpy(read_configuration(path)),
        clean=torch.from_numpy(clean),
        adversarial=torch.from_numpy(adversarial),
        artifacts=artifacts,
        search=None,
        # The scene and the model are loaded when they are needed for the first time.
        parts=cache(partial(load_parts_of_run, path)),
    )


def _load_artifacts(path: Path) -> dict[str, Tensor]:
    """Load the artifacts of a run, such as textures, by the names of their files.

    Args:
        path: folder of the run.

    Returns:
        Images (h, w, channels), linear.
    """
    artifacts = dict[str, Tensor]()
    for file in sorted((path / ARTIFACTS).glob("*.exr")):
        planes, _ = read_exr(file, read_bytes(file, "a picture of a run", LARGEST_FILE))
        artifacts[file.stem] = torch.from_numpy(
            np.stack([np.asarray(plane, np.float32) for plane in planes], axis=-1)
        )
    return artifacts


class ModelKeywords(TypedDict, total=False):
    """Options of a model, as in `advsearch.models.load_model`."""

    labels: str | os.PathLike[str] | Sequence[str] | None
    prompt: str | Sequence[str] | None
    name: str | None
    input_size: int | Sequence[int] | str | None
    mean: float | Sequence[float] | str | None
    std: float | Sequence[float] | str | None
    value_range: Sequence[float] | str | None
    layout: str | None
    channels: str | None
    max_batch: int | None
    read: Read | None
    ask: Mapping[str, float] | None


def load_model(
    spec: str | Path | nn.Module | Model,
    *,
    task: AnyTask | None = None,
    **options: Unpack[ModelKeywords],
) -> Model:
    """Load a model as `advsearch.models.load_model` does, for a task by name.

    Code that `spec` names is allowed to run, since the caller typed it.

    Args:
        spec: name, file, address or code of a model, or a network.
        task: task for which the model is loaded; None for classification.
        options: other options of `advsearch.models.load_model`.
    """
    allow_code_in_settings({"model": spec})
    return models.load_model(
        spec, task=None if task is None else make_task(task), **options
    )


load_model.__doc__ = models.load_model.__doc__
load_model.__signature__ = inspect.signature(models.load_model)  # type: ignore[attr-defined]
load_model = with_checked_arguments(load_model)
render = allow_code_of_call(
    with_checked_arguments(hold_process_lock()(with_progress_option(rendering.render)))
)


def render_picture_file(
    config: RenderConfig, *, progress: Progress | None = None
) -> RenderResult:
    """Render the scene of a configuration, and write the image to a file.

    Args:
        config: settings of the scene, the model and the image.
        progress: object that displays the progress; None for no display.

    Returns:
        The names of the written files, the predictions and the warnings.

    Raises:
        InputError: a setting is wrong, or the file would replace one that is read.
        StorageError: the file cannot be written.
    """
    progress = progress or NullProgress()
    # an .exr file cannot show several views
    out = check_image_path(config.out, n_views=config.around or 1)
    aovs = parse_aovs(config.aov)
    _check_single_view_of_aovs(config, aovs)
    _check_replaces_no_input(config, out)
    rendering, model_warnings = _render_configuration(
        config, with_aovs=bool(aovs), progress=progress
    )
    warnings = [*rendering.warnings, *model_warnings]
    for text in warnings:
        progress.message(text)
    if aovs:  # layers of ground truth per pixel
        rendering.save_aov(out, aovs)
    image_size = rendering.save(out)
    prediction_path = rendering.save_predictions(out)
    return rendering.result(out, image_size, warnings, prediction_path)


def _check_single_view_of_aovs(config: RenderConfig, aovs: Collection[str]) -> None:
    """Check that layers of ground truth are rendered for a single view only.

    Args:
        config: settings of the image.
        aovs: names of the layers.

    Raises:
        InputError: there are layers, and several views.
    """
    if aovs and config.around is not None:
        raise InputError("aov: is of one view; leave `around` out")


def _render_configuration(
    config: RenderConfig, *, with_aovs: bool, progress: Progress
) -> tuple[Rendering, Sequence[str]]:
    """Render the scene of a configuration, with the predictions of its model.

    Args:
        config: settings of the scene, the model and the image.
        with_aovs: whether to render layers of ground truth, too.
        progress: object that displays the progress.

    Returns:
        The rendered image, and the warnings of loading the model.
    """
    progress.stage("loading the scene and the model")
    check_run_settings(config)
    controls = make_configured_controls(config, config.controls)
    scene = load_configured_scene(config)
    task = make_task(config.task)
    (model,), model_warnings = load_models([config.model], task, config)
    rendering = render(
        scene,
        model,
        task=task,
        label=config.label,
        judge=config.judge,
        controls=controls,
        around=config.around,
        spp=config.spp,
        aov=with_aovs,
        progress=progress,
        **config.image_settings,
    )
    return rendering, model_warnings


def _check_replaces_no_input(config: RenderConfig, out: Path) -> None:
    """Check that the file to write is not one that is read.

    Raises:
        InputError: a setting names the same file as an input, such as its object.
    """
    if not out.exists():
        return
    for spec in (config.object, config.environment, config.model, config.labels):
        if spec is not None and os.path.exists(spec) and out.samefile(spec):
            raise InputError(
                f"out: would replace {spec}, which is read; choose another name"
            )
