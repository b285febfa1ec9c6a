"""The images of a run's rows, rendered again at the size that the model sees, with what
is true of them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from advsearch.config import SceneConfig
from advsearch.engine.loading import Scene
from advsearch.engine.rendering import facts_about
from advsearch.engine.verifier import kept_configuration
from advsearch.errors import FileFormatError, InputError
from advsearch.options import Value
from advsearch.progress import Progress
from advsearch.questions.attack.carry_out import (
    ROLES_IN_SEARCH,
    parts_in,
    problem_of_parts,
)
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.summary import attack_of
from advsearch.questions.sweep.carry_out import scenes_of
from advsearch.questions.sweep.job import KIND
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.runs.directory import CONFIG, PARTS, find_run, is_run, read_python_only
from advsearch.runs.store import NAME, Row, Store
from advsearch.scene.outlines import SeenThing, seen_things
from advsearch.scene.renderer import Renderer
from advsearch.settings import read_yaml
from advsearch.tasks import Facts, Task

# kinds of rows of an attack that look at the clean scene
CLEAN = ("first control", "control")


@dataclass(frozen=True, eq=False)
class RenderedRow:
    """An image of a run, rendered again.

    Attributes:
        name: of its file without ending.
        picture: (H, W, 3) sRGB in [0, 1], rounded to 8 bits as the model sees it.
        task: of the first model.
        facts: what is true of the object.
        renderer: of the scene.
        u: (d,) the configuration.
        rows: what the models of the run say of it.
        values: the configuration by parameter.
        same: whether the first model is right, or wrong, as its row says.
    """

    name: str
    picture: Tensor
    task: Task
    facts: Facts
    renderer: Renderer
    u: Tensor
    rows: Sequence[Row]
    values: Mapping[str, Value]
    same: bool

    def list_things(self) -> Sequence[SeenThing]:
        """Return the things that the image shows: the object, and those beside it."""
        return seen_things(self.renderer, self.u)

    def label_of(self, thing: SeenThing) -> str:
        """Return what the mesh of a thing is called, or else its name."""
        return self.renderer.scene.made[0].meshes[thing.name].label or thing.name


def render_rows(run: str, *, every: bool, progress: Progress) -> Iterator[RenderedRow]:
    """Render the images of a run of `sweep` or `attack`, or of one with such parts (a
    suite, a study).

    With `every` all, else those that not all models are right about. Raises InputError
    where the scene of the run is not to be had any more, and FileFormatError where the
    run is of another command, or has not ended.
    """
    yield from _render_run(find_run(run), every, progress)


def _render_run(folder: Path, every: bool, progress: Progress) -> Iterator[RenderedRow]:
    if parts := [part for part in sorted((folder / PARTS).glob("*")) if is_run(part)]:
        for part in parts:
            for shown in _render_run(part, every, progress):
                yield replace(shown, name=f"{part.name}-{shown.name}")
        return
    command = str(read_yaml(folder / CONFIG).get("command"))
    if command not in READ:
        raise InputError(
            f"{folder}: expected a run of {' or '.join(READ)}, or one with such parts, "
            f"got one of {command}"
        )
    if needed := [
        part.text
        for part in read_python_only(folder)
        if part.role not in ROLES_IN_SEARCH
    ]:
        raise InputError(
            f"{folder}: {', '.join(needed)}: only the Python session that "
            "asked has what renders it"
        )
    yield from READ[command](folder, every, progress)


def _swept(folder: Path, every: bool, progress: Progress) -> Iterator[RenderedRow]:
    scenes = scenes_of(
        SweepConfig.from_yaml(folder / CONFIG).model_copy(update={"metrics": {}})
    )
    job = scenes.job
    rows = defaultdict[int, list[Row]](list)
    with Store(folder / NAME, read_only=True) as store:
        for row in store.rows(KIND):
            rows[row.step // len(job.models)].append(row)
    chosen = sorted(
        number
        for number, some in rows.items()
        if every or not all(row.correct for row in some)
    )
    count = job.per_scene * len(job.places)
    if chosen and not 0 <= chosen[0] <= chosen[-1] < count:
        raise FileFormatError(
            f"{folder / NAME}: expected rows of its {count} "
            "pictures, got one of another"
        )
    progress.stage("rendering pictures", len(chosen))
    for number in chosen:
        view, (query, *_) = scenes.asked(number)
        place = job.places[view.number]
        some = sorted(rows[number], key=lambda row: row.step)
        facts = object_facts(place.scene, place.object, job.config)
        size = job.sizes[0]
        picture = view.picture(query)
        first = next(
            (row.correct for row in some if row.step % len(job.models) == 0), None
        )
        same = first in (None, view.problems[0].judge(picture, query.u).right)
        scene = job.tasks[0], facts, view.renderers[size], query.u
        yield RenderedRow(f"{number:06d}", picture, *scene, some, some[0].values, same)
        progress.advance(1)


def _attacked(folder: Path, every: bool, progress: Progress) -> Iterator[RenderedRow]:
    """The trials of an attack's adversarial scene, and of the clean one; where nothing
    varies, the first of each.
    """
    summary = attack_of(folder)
    parts = parts_in(folder)
    problem, _ = problem_of_parts(parts)
    kinds = dict.fromkeys(CLEAN, problem.domain.start)
    if summary.adversarial is not None:
        kinds["baseline verification" if summary.answer_from else "verification"] = (
            kept_configuration(folder, problem)
        )
    with Store(folder / NAME, read_only=True) as store:
        tried = {
            kind: [row for row in store.rows(kind) if every or not row.correct]
            for kind in kinds
        }
    chosen = [
        row
        for rows in tried.values()
        for row in (rows if problem.conditions else rows[:1])
    ]
    progress.stage("rendering pictures", len(chosen))
    for row in chosen:
        u = kinds[row.kind]
        seed = max(0, row.seed or 0)
        spp = row.spp or problem.spp
        picture = problem.picture(u, seed, spp)
        whole = problem.whole(u, seed)
        facts = object_facts(parts.scene, parts.config.object, parts.config)
        same = row.correct in (None, problem.judge(picture, whole).right)
        values = {**problem.describe(u, seed), **row.values}
        scene = (problem.task, facts, problem.renderer, whole)
        name = f"{row.kind.replace(' ', '-')}-{row.step:02d}"
        yield RenderedRow(name, picture, *scene, [row], values, same)
        progress.advance(1)


def object_facts(scene: Scene, name: str, config: SceneConfig) -> Facts:
    """What is known of the object, whatever the run judges: a label that was given is
    that of the judged thing.
    """
    judges_object = config.judge not in scene.description.things
    return facts_about(
        scene.description, name, config.label if judges_object else None, dict
    )


READ = {SweepConfig.command: _swept, AttackConfig.command: _attacked}
