"""Compare photographs of the real object with the renderings of a run.

Each photograph is predicted by the run's models, evaluated by its task, stored in the
run, and counted in a table of agreement.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from PIL import Image
from pydantic import JsonValue

from advsearch.extend import (
    AttackConfig,
    InputError,
    Model,
    RunDirectory,
    Store,
    SweepConfig,
    Task,
    directory,
    errors,
    markup,
    seeds,
    settings,
    statistics,
    stored_files,
    tasks,
    workbench,
    writing,
)
from advsearch.questions.photographs import result
from advsearch.questions.photographs.result import (
    LOOSE_PHOTO,
    PHOTO,
    PhotoAgreement,
    PhotographedRendering,
)

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
"""Of files that are photographs."""
ALIGNED_NAME = re.compile(r"rendering-([0-9]{1,12})(?:-.*)?")
"""Name of the file of a photograph that was aligned with a rendering."""
STORED_FIELDS = ("rendering", "right", "label", "file")
"""What a stored photograph says of its rendering, and its own file."""


@workbench.with_checked_arguments
def photo_agreement(run: str | Path) -> PhotoAgreement:
    """Return how the photographs of a run agree with its renderings (docs/viewer.md).

    Args:
        run: a run's name or folder.

    Raises:
        UnknownNameError: there is no such run.
        FileFormatError: what was kept of a photograph is something else.
    """
    table = _read_photos(directory.find_run(run))
    n_photos = len(table)
    n_agreeing = int(table["agrees"].sum())
    agreement = None
    interval = None
    if n_photos:
        agreement = n_agreeing / n_photos
        interval = statistics.intervals.clopper_pearson(n_agreeing, n_photos)
    return PhotoAgreement(
        photos=n_photos,
        agreement=agreement,
        interval=interval,
        renderings=[
            _summarize_rendering(str(name), str(model), photos)
            for (name, model), photos in table.groupby(
                ["rendering", "model"], sort=False
            )
        ],
        **_count_outcomes(table),
    )


def _read_photos(run: Path) -> pd.DataFrame:
    """Read the aligned photographs of a run, one row for each prediction.

    Columns: those of `STORED_FIELDS`; "model", "correct" and "predicted" of the
    photograph; and "agrees", whether it is right where the rendering is.
    """
    rows = list[dict[str, object]]()
    with workbench.hold_process_lock(), Store.open_to_read(run) as store:
        for row in store.rows(PHOTO):
            photo = _stored_photo(row)
            if not photo.keys() >= set(STORED_FIELDS):
                raise errors.FileFormatError(
                    f"row {row.id}: expected what was kept of a photograph, got "
                    "something else"
                )
            model = str(row.values["model"]["value"]) if "model" in row.values else ""
            rows.append(
                {
                    **photo,
                    "right": bool(photo["right"]),
                    "model": model,
                    "correct": bool(row.correct),
                    "predicted": row.label or "",
                }
            )
    columns = [*STORED_FIELDS, "model", "correct", "predicted"]
    table = pd.DataFrame(rows, columns=columns)
    table["agrees"] = table["right"] == table["correct"]
    return table


def _stored_photo(row: workbench.Row) -> dict[str, Any]:
    """Return what is stored of a photograph; empty for rows of another kind.

    It has the `STORED_FIELDS`, and "source", the name of the file that it came from;
    that is empty if a browser sent it.
    """
    photo = row.payload.get("photo") if isinstance(row.payload, dict) else None
    return photo if isinstance(photo, dict) else {}


def _count_outcomes(table: pd.DataFrame) -> dict[str, int]:
    """Count photographs by whether the rendering and the photograph are right.

    Keys are those of `PhotoAgreement`: right_right, right_wrong, wrong_right and
    wrong_wrong, the rendering first.
    """
    counts = table.groupby(["right", "correct"]).size()
    word_of = {True: "right", False: "wrong"}
    return {
        f"{word_of[rendered]}_{word_of[photographed]}": int(
            counts.get((rendered, photographed), 0)
        )
        for rendered in word_of
        for photographed in word_of
    }


def _summarize_rendering(
    name: str, model: str, photos: pd.DataFrame
) -> PhotographedRendering:
    """Summarise the photographs of one rendering, as one model predicts them.

    Args:
        name: name of the rendering.
        model: its name.
        photos: photos from `_read_photos`; the last one states what the rendering is.
    """
    n_photos = len(photos)
    n_agreeing = int(photos["agrees"].sum())
    latest = photos.iloc[-1]
    return PhotographedRendering(
        rendering=name,
        model=model,
        label=str(latest["label"]),
        rendering_right=bool(latest["right"]),
        photos=n_photos,
        photos_right=int(photos["correct"].sum()),
        agreeing=n_agreeing,
        interval=statistics.intervals.clopper_pearson(n_agreeing, n_photos),
        labels=list(photos["predicted"]),
        files=[str(file) for file in photos["file"]],
    )


def find_photographs(path: Path, task: workbench.AnyTask) -> list[Path]:
    """Return the photographs in a directory by their suffixes; empty without it.

    Raises:
        InputError: the task needs the object's position, and a photograph was aligned
            with no rendering.
    """
    files = sorted(path.iterdir()) if path.is_dir() else []
    photographs = [
        file for file in files if file.suffix.lower() in SUFFIXES and file.is_file()
    ]
    loose = [file for file in photographs if not ALIGNED_NAME.fullmatch(file.stem)]
    if loose:
        task_object = workbench.make_task(task)
        if task_object and _needs_position(task_object):
            raise InputError(
                f"{loose[0].name}: the task asks where the object is, and only a "
                "rendering says that; name the file rendering-NUMBER.jpg by the "
                "rendering that it was aligned with, or take it out"
            )
    return photographs


def _needs_position(task: Task) -> bool:
    """Return whether the ground truth of a task depends on the configuration."""
    return bool(task.varies or task.calibrates)


class Photographs:
    """Store photographs in runs, one at a time and from any thread.

    The scene and the models of the last run stay loaded.

    Attributes:
        row_kinds: the kinds of rows that photographs have in the results of a run.
    """

    row_kinds = (PHOTO, LOOSE_PHOTO)

    def __init__(self) -> None:
        # of the last run
        self._load_evaluators = lru_cache(maxsize=1)(_load_evaluators)
        # A scene is used only by the thread that loaded it.
        self._thread = ThreadPoolExecutor(1, "photographs")

    def add(self, run: Path, rendering: str, data: bytes) -> PhotoAgreement:
        """Evaluate and store a photograph, and return the table of agreement.

        Args:
            run: the directory of the run.
            rendering: name of the rendering that it was aligned with.
            data: the image file.

        Raises:
            InputError: there is no such rendering, the data is no photograph, another
                process works on the run, or its scene has changed.
        """
        self._add_in_thread(run, rendering, data, source="")
        return photo_agreement(run)

    def _add_in_thread(
        self, run: Path, rendering: str | None, data: bytes, source: str
    ) -> None:
        """Evaluate and store a photograph in the thread of the scene, and wait."""
        self._thread.submit(self._add, run, rendering, data, source).result()

    def add_files(self, run: Path, files: Sequence[Path]) -> None:
        """Evaluate and store the photographs that a sweep of one object does not have.

        A file ``rendering-12.jpg``, or ``rendering-12-`` and anything, was aligned with
        the rendering 12. All others show the object as it stood by chance: they are
        evaluated, but are compared with no single rendering.
        """
        with Store.open_to_read(run) as store:
            stored_names = {
                _stored_photo(row).get("source")
                for kind in (PHOTO, LOOSE_PHOTO)
                for row in store.rows(kind)
            }
        for file in files:
            if file.name in stored_names:
                continue
            aligned = ALIGNED_NAME.fullmatch(file.stem)
            rendering = aligned[1] if aligned else None
            data = stored_files.read_bytes(file, "a photograph", markup.MAX_BODY_BYTES)
            try:
                self._add_in_thread(run, rendering, data, source=file.name)
            except InputError as error:
                raise InputError(f"{file.name}: {error}") from None

    def agreement(self, run: Path) -> PhotoAgreement:
        """Return the table of agreement of a run."""
        return photo_agreement(run)

    @staticmethod
    def list_files(folder: Path, task: workbench.AnyTask) -> list[Path]:
        """Return the photographs in a directory; see `find_photographs`."""
        return find_photographs(folder, task)

    def _add(self, run: Path, rendering: str | None, data: bytes, source: str) -> None:
        """Evaluate a photograph by all models of a run, and store it.

        It is cut to the size of the rendering, or else of the model's images. Without a
        rendering only the predictions are stored.

        Args:
            run: the directory of the run.
            rendering: name of the rendering that it was aligned with, if any.
            data: the image file.
            source: name of the file that it came from; empty if a browser sent it.
        """
        file = None
        cut_photo = b""
        if rendering is not None:
            file = result.find_rendering(run, rendering)
            with Image.open(file, formats=("PNG", "JPEG")) as image:
                # A bad photograph is rejected before a scene is loaded.
                cut_photo = result.sanitize_photo(data, image.size)
        with RunDirectory.resume(run) as resumed_run:
            kind = PHOTO if rendering else LOOSE_PHOTO
            number = resumed_run.store.get_last_step(kind) + 1
            photo = dict[str, JsonValue](source=source)
            rows = []
            for evaluator in self._load_evaluators(run):
                values: Mapping[str, workbench.Value] = {}
                if file is None or rendering is None:
                    cut_photo = result.sanitize_photo(data, evaluator.size[::-1])
                else:
                    right, label, values = evaluator.evaluate_rendering(
                        resumed_run.store, rendering, file
                    )
                    photo |= {"rendering": rendering, "right": right, "label": label}
                    photo["file"] = f"{rendering}-{number:04d}.jpg"
                row = workbench.Row(kind, number, values=values)
                row = _add_prediction(row, evaluator, rendering, cut_photo)
                payload = {"photo": {**photo}, "answer": row.payload}
                rows.append(replace(row, payload=payload))
            _write_photo(run, file, photo, cut_photo)
            resumed_run.append_rows(*rows)


def _add_prediction(
    row: workbench.Row,
    evaluator: _PhotoEvaluator,
    rendering: str | None,
    cut_photo: bytes,
) -> workbench.Row:
    """Return a row with a model's prediction on a photograph.

    Args:
        row: row with the values of the rendering, if there is one.
        evaluator: evaluator of the model, whose name is added to the values.
        rendering: name of the rendering that the photograph was aligned with, if any.
        cut_photo: the image file.
    """
    # A sweep over several objects stores which one it was.
    object_name = None
    if "object" in row.values:
        object_name = str(row.values["object"]["value"])
    model_value: workbench.Value = {"value": evaluator.model.name, "unit": ""}
    row = replace(row, values={**row.values, "model": model_value})
    judgement = evaluator.evaluate(rendering, object_name, cut_photo)
    return workbench.add_judgement(row, judgement)


def _write_photo(
    run: Path, file: Path | None, photo: Mapping[str, JsonValue], cut_photo: bytes
) -> None:
    """Write a photograph into the folder of a run if it belongs to a rendering."""
    if file is not None:
        path = run / directory.PHOTOGRAPHS / str(photo["file"])
        writing.write_bytes(path, cut_photo)


@dataclass(frozen=True)
class _PhotoEvaluator:
    """Evaluate photographs by one model of a run.

    Attributes:
        model: predicts.
        task: evaluates the prediction.
        size: (height, width) in pixels of the images that the model is run on.
        find_truth: returns the ground truth of a photograph by the name of the
            rendering that it was aligned with and of the object; None for a photograph
            that was aligned with none, and for the only object.
        index: index of the model, among `n_models` of the run.
    """

    model: Model
    task: Task
    size: tuple[int, int]
    find_truth: Callable[[str | None, str | None], workbench.Truth]
    index: int
    n_models: int

    def evaluate(
        self, rendering: str | None, object_name: str | None, data: bytes
    ) -> tasks.Judgement:
        """Evaluate an image file at the size of the run's renderings.

        It is resized in 8 bits with Lanczos' filter, which averages where it shrinks.
        """
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "WEBP")) as image:
            resized = image.convert("RGB").resize(
                self.size[::-1], Image.Resampling.LANCZOS
            )
        pixels = torch.from_numpy(
            np.asarray(resized, dtype=np.float32) / np.float32(255.0)
        )
        with torch.no_grad():
            output = self.model(pixels)
            truth = self.find_truth(rendering, object_name)
            return workbench.judge_images(self.task, output, pixels[None], [truth])[0]

    def evaluate_rendering(
        self, store: Store, rendering: str, file: Path
    ) -> tuple[bool, str, Mapping[str, workbench.Value]]:
        """Return whether a rendering is right, its label, and the values of its row.

        A sweep's prediction is read from its row; others are made from the file.

        Raises:
            InputError: the results have no row of a sweep's rendering.
        """
        if rendering.isdigit():
            row = store.read_row("sweep", int(rendering) * self.n_models + self.index)
            if row is not None:
                return bool(row.correct), row.label or "", row.values
        if file.suffix != ".png":
            raise InputError(
                f"rendering: the results have no row for {file.stem}; it "
                "belongs to another run"
            )
        judgement = self.evaluate(rendering, None, file.read_bytes())
        return judgement.right, judgement.prediction.label, {}


def _load_evaluators(run: Path) -> list[_PhotoEvaluator]:
    """Load what evaluates photographs of a run, one for each of its models.

    Raises:
        InputError: the run is no attack and no sweep.
    """
    path = run / directory.CONFIG
    command = settings.read_yaml(path).get("command")
    if command == "sweep":
        return _load_sweep_evaluators(SweepConfig.from_yaml(path))
    if command == "attack":
        return _load_attack_evaluators(run, AttackConfig.from_yaml(path))
    raise InputError(
        f"{run.name}: photographs belong to renderings of attacks and "
        f"sweeps, not of {command}"
    )


def _load_sweep_evaluators(config: SweepConfig) -> list[_PhotoEvaluator]:
    """Load the models of a sweep, with the ground truth of its images."""
    sweep = workbench.load_scenes_of_sweep(config)
    models = zip(sweep.job.models, sweep.job.tasks, sweep.job.image_sizes, strict=True)
    return [
        _PhotoEvaluator(
            model=model,
            task=task,
            size=size,
            find_truth=partial(_find_sweep_truth, sweep, index),
            index=index,
            n_models=len(sweep.job.models),
        )
        for index, (model, task, size) in enumerate(models)
    ]


def _find_sweep_truth(
    sweep: Any, model_index: int, image_number: str | None, object_name: str | None
) -> workbench.Truth:
    """Return the ground truth of an image of a sweep for the task of a model.

    If that does not depend on the configuration, or no image is named, it is that of
    the object.

    Args:
        sweep: the loaded scenes (`SceneLoader`).
        model_index: model index of the model.
        image_number: number of the image as text; None for a photograph that was
            aligned with none.
        object_name: object name of the object; None, or one that the sweep does not
            have, for its first one, which is the only one then.

    Raises:
        InputError: the sweep has no such image.
    """
    job = sweep.job
    task = job.tasks[model_index]
    if image_number is None or not _needs_position(task):
        named_scene = next(
            (scene for scene in job.scenes if scene.object == object_name),
            job.scenes[0],
        )
        return task.truth(job.make_facts(named_scene, {}))
    number = int(image_number)
    if number >= job.images_per_scene * len(job.scenes):
        raise InputError(
            f"rendering: the sweep has no picture {image_number}; it "
            "belongs to another run"
        )
    scene, queries = sweep.make_queries(number)
    query = queries[model_index]
    return scene.problems[model_index].find_truth(query.u, query.values)


def _load_attack_evaluators(run: Path, config: AttackConfig) -> list[_PhotoEvaluator]:
    """Load the models of an attack, with the ground truth of its images."""
    problem, _ = workbench.problem_from_config(workbench.with_evaluation_only(config))

    def find_truth(task: Task, rendering: str | None, _: str | None) -> workbench.Truth:
        """Return the ground truth of the clean or adversarial scene, or of a trial.

        Renderings are named "clean", "adversarial" or "verification-NUMBER"; a trial
        has the conditions of its seed, the others those that the scene comes with. The
        clean scene stands for a photograph without a rendering, and for a task that
        does not depend on the configuration.
        """
        u = problem.domain.start
        is_adversarial = rendering not in (None, "clean")
        if is_adversarial and _needs_position(task):
            u = workbench.read_stored_configuration(run, problem)
        _, _, trial = (rendering or "").rpartition("verification-")
        seed = None
        if trial.isdigit():
            seed = seeds.stream(problem.seed, "verification", int(trial))
        configuration = problem.add_conditions(u, seed)
        facts = problem.make_facts(
            lambda: problem.space.describe(configuration),
            lambda: problem.renderer.surfaces(configuration),
        )
        return task.truth(facts)

    models: list[tuple[Model, Task]] = [(problem.model, problem.task)]
    if isinstance(problem.task, workbench.EnsembleTask):
        models = list(zip(problem.task.models, problem.task.tasks, strict=True))
    return [
        _PhotoEvaluator(
            model=model,
            task=task,
            size=config.resolution or model.input_size,
            find_truth=partial(find_truth, task),
            index=index,
            n_models=len(models),
        )
        for index, (model, task) in enumerate(models)
    ]
