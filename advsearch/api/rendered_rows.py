"""Render the images of a run again, with their ground truth.

An image has the size of the model's input. A row of a run is the stored prediction of a
model for an image.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from advsearch.config import SceneConfig
from advsearch.engine.loading import Scene
from advsearch.engine.problem import Problem
from advsearch.engine.rendering import make_facts
from advsearch.engine.verifier import read_stored_configuration
from advsearch.errors import FileFormatError, InputError
from advsearch.options import Value
from advsearch.progress import Progress
from advsearch.questions.attack.carry_out import (
    ROLES_IN_SEARCH,
    AttackParts,
    load_parts_of_run,
    make_problem_with_warnings,
)
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.summary import AttackSummary, load_attack_summary
from advsearch.questions.sweep.carry_out import load_scenes_of_sweep
from advsearch.questions.sweep.job import KIND, SceneLoader
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.runs.directory import CONFIG, PARTS, find_run, is_run, read_python_only
from advsearch.runs.store import NAME, Row, Store
from advsearch.scene.outlines import VisibleMesh, find_visible_meshes
from advsearch.scene.renderer import Renderer
from advsearch.settings import read_yaml
from advsearch.tasks import Facts, Task

# Kinds of the rows of an attack that are about the clean scene.
CLEAN_KINDS = ("first control", "control")


@dataclass(frozen=True, eq=False)
class RenderedRow:
    """An image of a run, rendered again.

    Attributes:
        name: name of its file without a suffix.
        picture: (H, W, 3), sRGB in [0, 1], rounded to 8 bits as the model's input is.
        task: task of the first model.
        facts: the ground truth of the object.
        renderer: renderer of the scene.
        u: (d,), the configuration.
        rows: stored predictions of the run's models for the image.
        values: the values of the configuration, by parameter.
        is_reproduced: whether the first model is right if it was right in the run, and
            wrong if it was wrong.
    """

    name: str
    picture: Tensor
    task: Task
    facts: Facts
    renderer: Renderer
    u: Tensor
    rows: Sequence[Row]
    values: Mapping[str, Value]
    is_reproduced: bool

    def list_things(self) -> Sequence[VisibleMesh]:
        """Return the visible things in the image: the object, and the others."""
        return find_visible_meshes(self.renderer, self.u)

    def get_label(self, thing: VisibleMesh) -> str:
        """Return the label of a thing's mesh, or else its name."""
        description, _filter = self.renderer.scene.description_and_filter
        return description.meshes[thing.name].label or thing.name


def render_rows(run: str, *, every: bool, progress: Progress) -> Iterator[RenderedRow]:
    """Render the images of a run again.

    The run is of `sweep` or `attack`, or it consists of such runs, as a suite or a
    study does.

    Args:
        run: name or folder of the run.
        every: whether to render all images; otherwise only those about which a model is
            wrong.
        progress: object that displays the number of images.

    Raises:
        InputError: the scene of the run does not exist any more.
        FileFormatError: the run is of another command, or has not finished.
    """
    yield from _render_run(find_run(run), every, progress)


def _render_run(folder: Path, every: bool, progress: Progress) -> Iterator[RenderedRow]:
    """Yield the rendered images of the run in a folder, or of its parts.

    Args:
        folder: folder of the run.
        every: whether to render all images; otherwise only those about which a model is
            wrong.
        progress: object that displays the number of images.

    Raises:
        InputError: the run is of another command, or needs objects of a Python session.
    """
    parts = [path for path in sorted((folder / PARTS).glob("*")) if is_run(path)]
    if parts:
        for part in parts:
            for rendered in _render_run(part, every, progress):
                yield replace(rendered, name=f"{part.name}-{rendered.name}")
        return
    command = str(read_yaml(folder / CONFIG).get("command"))
    _check_renderable_command(folder, command)
    _check_renderable_parts(folder)
    yield from RENDERERS[command](folder, every, progress)


def _check_renderable_command(folder: Path, command: str) -> None:
    """Check that the images of a run's command can be rendered again.

    Raises:
        InputError: they cannot.
    """
    if command not in RENDERERS:
        raise InputError(
            f"{folder}: expected a run of {' or '.join(RENDERERS)}, or one with such "
            f"parts, got one of {command}"
        )


def _check_renderable_parts(folder: Path) -> None:
    """Check that nothing that rendering needs existed only in a Python session.

    Raises:
        InputError: something did.
    """
    # Others, such as a policy, were needed by the search only.
    missing = [
        part.text
        for part in read_python_only(folder)
        if part.role not in ROLES_IN_SEARCH
    ]
    if missing:
        raise InputError(
            f"{folder}: {', '.join(missing)}: only the Python session that "
            "asked has what renders it"
        )


def _render_sweep(
    folder: Path, every: bool, progress: Progress
) -> Iterator[RenderedRow]:
    """Yield the rendered images of a sweep, one at a time.

    Args:
        folder: folder of the run.
        every: render all images; otherwise only those about which a model is wrong.
        progress: reports the number of images.

    Raises:
        FileFormatError: the run has rows of images that its settings do not make.
    """
    config = SweepConfig.from_yaml(folder / CONFIG)
    # Metrics are left out, since they are not computed again.
    scenes = load_scenes_of_sweep(config.model_copy(update={"metrics": {}}))
    job = scenes.job
    rows_of_image = _read_sweep_rows(folder, len(job.models))
    images = _select_sweep_images(rows_of_image, every)
    _check_image_indices(folder, images, job.images_per_scene * len(job.scenes))
    progress.stage("rendering pictures", len(images))
    for image in images:
        rows = sorted(rows_of_image[image], key=lambda row: row.step)
        yield _render_sweep_image(scenes, image, rows)
        progress.advance(1)


def _select_sweep_images(
    rows_of_image: Mapping[int, Sequence[Row]], every: bool
) -> list[int]:
    """Return the sorted indices of the images to render.

    Args:
        rows_of_image: rows of the sweep by the index of their image.
        every: whether to select all images; otherwise only those about which a model is
            wrong. An image that was not judged (`correct` is None) counts as wrong.
    """
    return sorted(
        image
        for image, rows in rows_of_image.items()
        if every or not all(row.correct for row in rows)
    )


def _check_image_indices(folder: Path, images: Sequence[int], n_images: int) -> None:
    """Check that a sweep has the images of its rows.

    Args:
        folder: folder of the run, for the message.
        images: sorted indices of the images of its rows.
        n_images: number of images that its settings make.

    Raises:
        FileFormatError: it does not.
    """
    # The indices are sorted, so that checking the first and the last one is enough.
    if images and not 0 <= images[0] <= images[-1] < n_images:
        raise FileFormatError(
            f"{folder / NAME}: expected rows of its {n_images} pictures, got one of "
            "another"
        )


def _render_sweep_image(
    scenes: SceneLoader, image: int, rows: Sequence[Row]
) -> RenderedRow:
    """Render one image of a sweep.

    Args:
        scenes: scenes of the sweep.
        image: index of the image.
        rows: stored predictions of all models for it; the rendered image is judged
            again and compared with the first model's.
    """
    job = scenes.job
    loaded_scene, queries = scenes.make_queries(image)
    query = queries[0]  # all models get the same image
    scene = job.scenes[loaded_scene.number]
    picture = loaded_scene.render_image(query)
    was_right = _get_first_prediction(rows, len(job.models))
    problem_of_first_model = loaded_scene.problems[0]
    is_right = problem_of_first_model.judge(picture, query.u).right
    return RenderedRow(
        name=f"{image:06d}",
        picture=picture,
        task=job.tasks[0],
        facts=make_object_facts(scene.scene, scene.object_name, job.config),
        renderer=loaded_scene.renderer_of_size[job.image_sizes[0]],
        u=query.u,
        rows=rows,
        values=rows[0].values,
        is_reproduced=was_right in (None, is_right),
    )


def _get_first_prediction(rows: Sequence[Row], n_models: int) -> bool | None:
    """Return whether the first model was right in the run; None if that is not stored.

    Args:
        rows: rows of one image, with steps in the order of the models.
        n_models: number of models of the sweep.
    """
    return next((row.correct for row in rows if row.step % n_models == 0), None)


def _read_sweep_rows(folder: Path, n_models: int) -> dict[int, list[Row]]:
    """Return the rows of a sweep by the index of their image."""
    rows_of_image = defaultdict[int, list[Row]](list)
    with Store(folder / NAME, read_only=True) as store:
        for row in store.rows(KIND):
            rows_of_image[row.step // n_models].append(row)
    return rows_of_image


def _render_attack(
    folder: Path, every: bool, progress: Progress
) -> Iterator[RenderedRow]:
    """Yield rendered trials of an attack's clean scene and of its adversarial scene.

    A trial is a verification render. If no condition varies at random, such as the
    camera, trials differ in noise only, and one trial of each scene is rendered.

    Args:
        folder: folder of the run.
        every: whether to render all trials; otherwise only those in which the model is
            wrong.
        progress: object that displays the number of images.
    """
    summary = load_attack_summary(folder)
    parts = load_parts_of_run(folder)
    problem, _ = make_problem_with_warnings(parts)
    configuration_of_kind = _read_trial_configurations(folder, summary, problem)
    # without conditions, trials of a scene differ in noise only
    max_trials = None if problem.conditions else 1
    rows = list[Row]()
    for kind in configuration_of_kind:
        rows += _read_trials(folder, kind, every)[:max_trials]
    progress.stage("rendering pictures", len(rows))
    for row in rows:
        yield _render_trial(parts, problem, row, configuration_of_kind[row.kind])
        progress.advance(1)


def _read_trial_configurations(
    folder: Path, summary: AttackSummary, problem: Problem
) -> dict[str, Tensor]:
    """Return the configuration u (d,) of an attack's trials, by the kind of their rows.

    Args:
        folder: folder of the run.
        summary: result of the run.
        problem: its problem.
    """
    # The search starts at the clean scene.
    configuration_of_kind = dict.fromkeys(CLEAN_KINDS, problem.domain.start)
    if summary.adversarial is not None:
        # `adversarial_from` is set if a baseline, and not the search, found the
        # adversarial scene.
        kind = "baseline verification" if summary.adversarial_from else "verification"
        configuration_of_kind[kind] = read_stored_configuration(folder, problem)
    return configuration_of_kind


def _render_trial(
    parts: AttackParts, problem: Problem, row: Row, u: Tensor
) -> RenderedRow:
    """Render one trial of an attack again.

    Args:
        parts: scene, model and settings of the run.
        problem: its problem.
        row: stored prediction of the trial.
        u: (d,), the configuration of the trial.
    """
    seed = max(0, row.seed or 0)  # a row may lack its seed
    # a row may lack its samples, too
    picture = problem.picture(u, seed, row.spp or problem.search_spp)
    # `u` followed by the conditions that the seed samples
    full_u = problem.make_full_configuration(u, seed)
    is_right = problem.judge(picture, full_u).right
    return RenderedRow(
        name=f"{row.kind.replace(' ', '-')}-{row.step:02d}",
        picture=picture,
        task=problem.task,
        facts=make_object_facts(parts.scene, parts.config.object, parts.config),
        renderer=problem.renderer,
        u=full_u,
        rows=[row],
        values={**problem.describe(u, seed), **row.values},
        is_reproduced=row.correct in (None, is_right),
    )


def _read_trials(folder: Path, kind: str, every: bool) -> list[Row]:
    """Return the rows of a kind in the store of a run: all, or those in which the model
    is wrong.
    """
    with Store(folder / NAME, read_only=True) as store:
        return [row for row in store.rows(kind) if every or not row.correct]


def make_object_facts(scene: Scene, name: str, config: SceneConfig) -> Facts:
    """Return the ground truth about the object of a scene.

    Args:
        scene: the scene.
        name: name of the object.
        config: settings of the run. If the run judges an additional object, `label` is
            the label of that one, and the object has its usual label.
    """
    judges_object = config.judge not in scene.description.things
    label = config.label if judges_object else None
    # `dict` describes no values: each parameter has its value in the scene.
    return make_facts(scene.description, name, label, describe=dict)


RENDERERS = {SweepConfig.command: _render_sweep, AttackConfig.command: _render_attack}
"""The renderers of runs by command."""
