"""`render`: pictures of a scene, written to a file, with what the model says of them."""

from __future__ import annotations

import os

from advsearch.config import RenderConfig
from advsearch.engine import rendering
from advsearch.engine.naming import check_run_settings, given_to, in_turn, load_models, scene_of
from advsearch.engine.rendering import Rendering as Rendering
from advsearch.engine.rendering import pictures_of, writable
from advsearch.errors import InputError
from advsearch.progress import NullProgress, Progress
from advsearch.runs.results.base import RenderResult
from advsearch.scene.surfaces import aovs_of
from advsearch.tasks import make_task
from advsearch.watching import shows_progress

render = in_turn()(shows_progress(rendering.render))


def render_from_config(config: RenderConfig, *, progress: Progress | None = None) -> RenderResult:
    """Render what a configuration describes, write the file, and return what is known about it.

    Raises:
        InputError: as for `render`, or the file would replace one that is read.
        StorageError: the file could not be written.
    """
    progress = progress or NullProgress()
    out, aovs = writable(config.out, config.around or 1), aovs_of(config.aov)
    if aovs and config.around is not None:
        raise InputError("aov: is of one view; leave `around` out")
    for spec in (config.object, config.environment, config.model, config.labels):
        if spec is not None and out.exists() and os.path.exists(spec) and out.samefile(spec):
            raise InputError(f"out: would replace {spec}, which is read; choose another name")
    progress.stage("loading the scene and the model")
    check_run_settings(config)
    controls = given_to(config, config.controls)
    scene = scene_of(config)
    task = make_task(config.task)
    (model,), notes = load_models([config.model], task, config)
    rendering = render(
        scene,
        model,
        task=task,
        label=config.label,
        controls=controls,
        around=config.around,
        spp=config.spp,
        aov=bool(aovs),
        progress=progress,
        **pictures_of(config),
    )
    warnings = [*rendering.warnings, *notes]
    for text in warnings:
        progress.message(text)
    if aovs:
        rendering.save_aov(out, aovs)
    return rendering.result(out, rendering.save(out), warnings, rendering.save_answers(out))
