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
    Problem,
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
"""Suffixes of files that are photographs."""
ALIGNED_NAME = re.compile(r"rendering-([0-9]{1,12})(?:-.*)?")
"""Name of the file of a photograph that was aligned with a rendering."""
STORED_FIELDS = ("rendering", "right", "label", "file")
"""What is stored with a photograph: name, correctness and predicted label of its
rendering, and the photograph's own file.
"""


@workbench.with_checked_arguments
def photo_agreement(run: str | Path) -> PhotoAgreement:
    """Return how the photographs of a run agree with its renderings (docs/viewer.md).

    A photograph agrees with its rendering if the model is right in both or wrong in
    both.

    Args:
        run: a run's name or folder.

    Raises:
        UnknownNameError: there is no such run.
        FileFormatError: a stored photograph has no valid row.
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
        renderings=_summarize_renderings(table),
        **_count_outcomes(table),
    )


def _read_photos(run: Path) -> pd.DataFrame:
    """Read the aligned photographs of a run, one row for each prediction.

    The columns are those of `STORED_FIELDS`, which are about the rendering; "model",
    "correct" and "predicted", which are about the photograph; and "agrees", whether
    both predictions are right or both are wrong.
    """
    with workbench.hold_process_lock(), Store.open_to_read(run) as store:
        rows = [_make_photo_row(row) for row in store.rows(PHOTO)]
    columns = [*STORED_FIELDS, "model", "correct", "predicted"]
    table = pd.DataFrame(rows, columns=columns)
    table["agrees"] = table["right"] == table["correct"]
    return table


def _make_photo_row(row: workbench.Row) -> dict[str, object]:
    """Return the columns of a stored prediction about an aligned photograph.

    Raises:
        FileFormatError: the row lacks what is stored of a photograph.
    """
    photo = _stored_photo(row)
    has_all_fields = photo.keys() >= set(STORED_FIELDS)
    if not has_all_fields:
        raise errors.FileFormatError(
            f"row {row.id}: expected what was kept of a photograph, got something else"
        )
    model = str(row.values["model"]["value"]) if "model" in row.values else ""
    return {
        **photo,
        "right": bool(photo["right"]),
        "model": model,
        "correct": bool(row.correct),
        "predicted": row.label or "",
    }


def _stored_photo(row: workbench.Row) -> dict[str, Any]:
    """Return what is stored of a photograph; empty for rows of another kind.

    If the row is intact, it has the `STORED_FIELDS`, and "source": the name of the file
    that the photograph came from, which is empty if a browser sent it.
    """
    photo = row.payload.get("photo") if isinstance(row.payload, dict) else None
    return photo if isinstance(photo, dict) else {}


def _count_outcomes(table: pd.DataFrame) -> dict[str, int]:
    """Count photographs by whether the rendering and the photograph are right.

    Keys are those of `PhotoAgreement`: right_right, right_wrong, wrong_right and
    wrong_wrong, the rendering first.
    """
    counts = table.groupby(["right", "correct"]).size()
    outcomes = {"right": True, "wrong": False}
    return {
        f"{rendering}_{photograph}": int(
            counts.get((is_rendering_right, is_photograph_right), 0)
        )
        for rendering, is_rendering_right in outcomes.items()
        for photograph, is_photograph_right in outcomes.items()
    }


def _summarize_renderings(table: pd.DataFrame) -> list[PhotographedRendering]:
    """Summarize the photographs of each rendering and model."""
    groups = table.groupby(["rendering", "model"], sort=False)
    return [
        _summarize_rendering(str(name), str(model), photos)
        for (name, model), photos in groups
    ]


def _summarize_rendering(
    name: str, model: str, photos: pd.DataFrame
) -> PhotographedRendering:
    """Summarize the photographs of one rendering, as one model predicts them.

    Args:
        name: name of the rendering.
        model: name of the model.
        photos: their rows of `_read_photos`, at least one. Each also has the prediction
            on the rendering; the last one is used.
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
    """Return the paths of the photographs in a directory.

    They are found by their suffixes. The list is empty if there is no such directory.

    Raises:
        InputError: the task needs the object's position, which is known only from a
            rendering, and the name of a photograph names none.
    """
    files = sorted(path.iterdir()) if path.is_dir() else []
    photographs = [
        file for file in files if file.suffix.lower() in SUFFIXES and file.is_file()
    ]
    unaligned = [file for file in photographs if not ALIGNED_NAME.fullmatch(file.stem)]
    if unaligned:
        _check_unaligned(unaligned[0], task)
    return photographs


def _check_unaligned(file: Path, task: workbench.AnyTask) -> None:
    """Raise an error if a task needs the rendering of a photograph that names none."""
    loaded_task = workbench.make_task(task)
    if loaded_task and _needs_position(loaded_task):
        raise InputError(
            f"{file.name}: the task asks where the object is, and only a "
            "rendering says that; name the file rendering-NUMBER.jpg by the "
            "rendering that it was aligned with, or take it out"
        )


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
        # The evaluators of the last run are cached.
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
        """Evaluate the photographs that are not stored yet, and store them in the run.

        A file ``rendering-12.jpg``, or a name that begins with ``rendering-12-``, was
        aligned with the rendering 12. All other files show the object in any position.
        They are evaluated, but not compared with a rendering.
        """
        stored_names = _list_sources(run)
        for file in files:
            if file.name not in stored_names:
                self._add_file(run, file)

    def _add_file(self, run: Path, file: Path) -> None:
        """Evaluate and store the photograph of a file; an error names the file."""
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

        Args:
            run: the directory of the run.
            rendering: name of the rendering that it was aligned with, if any.
            data: the image file.
            source: name of the file that it came from; empty if a browser sent it.
        """
        if rendering is None:
            self._add_loose(run, data, source)
        else:
            self._add_aligned(run, rendering, data, source)

    def _add_loose(self, run: Path, data: bytes, source: str) -> None:
        """Evaluate and store a photograph that was aligned with no rendering.

        It is cropped to the size of each model's images.

        Args:
            run: directory of the run.
            data: the image file as bytes.
            source: where the photograph comes from, which is stored with it.
        """
        with RunDirectory.resume(run) as resumed_run:
            number = resumed_run.store.get_last_step(LOOSE_PHOTO) + 1
            rows = [
                _make_loose_row(evaluator, number, data, source)
                for evaluator in self._load_evaluators(run)
            ]
            resumed_run.append_rows(*rows)

    def _add_aligned(self, run: Path, rendering: str, data: bytes, source: str) -> None:
        """Evaluate a photograph that was aligned with a rendering, and store it.

        It is cropped to the size of the rendering. What is stored with it includes the
        model's prediction about the rendering.

        Args:
            run: directory of the run.
            rendering: name of the rendering that it was aligned with.
            data: the image file as bytes.
            source: where the photograph comes from, which is stored with it.
        """
        rendering_file = result.find_rendering(run, rendering)
        with Image.open(rendering_file, formats=("PNG", "JPEG")) as image:
            # A bad photograph is rejected before a scene is loaded.
            cut_photo = result.sanitize_photo(data, image.size)
        # The number of a photograph is one more than that of the one before.
        with RunDirectory.resume(run) as resumed_run:
            photo = _AlignedPhoto(
                number=resumed_run.store.get_last_step(PHOTO) + 1,
                rendering=rendering,
                rendering_file=rendering_file,
                source=source,
                cut_photo=cut_photo,
            )
            rows = [
                photo.make_row(evaluator, resumed_run.store)
                for evaluator in self._load_evaluators(run)
            ]
            writing.write_bytes(
                run / directory.PHOTOGRAPHS / photo.file_name, cut_photo
            )
            resumed_run.append_rows(*rows)


def _list_sources(run: Path) -> set[object]:
    """Return the names of the files that the photographs of a run came from."""
    with Store.open_to_read(run) as store:
        return {
            _stored_photo(row).get("source")
            for kind in (PHOTO, LOOSE_PHOTO)
            for row in store.rows(kind)
        }


def _make_loose_row(
    evaluator: _PhotoEvaluator, number: int, data: bytes, source: str
) -> workbench.Row:
    """Make the row of a model's prediction about a photograph without a rendering.

    Args:
        evaluator: evaluator of the model.
        number: number of the photograph.
        data: the image file.
        source: name of the file that it came from.
    """
    # `size` is (height, width), and the function takes (width, height).
    cut_photo = result.sanitize_photo(data, evaluator.size[::-1])
    return _add_prediction(
        workbench.Row(LOOSE_PHOTO, number, values={}),
        evaluator,
        rendering=None,
        cut_photo=cut_photo,
        stored_photo={"source": source},
    )


@dataclass(frozen=True)
class _AlignedPhoto:
    """A photograph that was aligned with a rendering.

    Attributes:
        number: number of the photograph in its run.
        rendering: name of the rendering.
        rendering_file: image of the rendering.
        source: name of the file that the photograph came from.
        cut_photo: the photograph, cropped to the rendering, an image file as bytes.
    """

    number: int
    rendering: str
    rendering_file: Path
    source: str
    cut_photo: bytes

    @property
    def file_name(self) -> str:
        """Name of the file that it is stored in."""
        return f"{self.rendering}-{self.number:04d}.jpg"

    def make_row(self, evaluator: _PhotoEvaluator, store: Store) -> workbench.Row:
        """Make the row of a model's predictions about photograph and rendering.

        Args:
            evaluator: evaluator of the model.
            store: stored rows of the run.
        """
        is_right, label, values = evaluator.evaluate_rendering(
            store, self.rendering, self.rendering_file
        )
        stored_photo: dict[str, JsonValue] = {
            "source": self.source,
            "rendering": self.rendering,
            "right": is_right,
            "label": label,
            "file": self.file_name,
        }
        return _add_prediction(
            workbench.Row(PHOTO, self.number, values=values),
            evaluator,
            rendering=self.rendering,
            cut_photo=self.cut_photo,
            stored_photo=stored_photo,
        )


def _add_prediction(
    row: workbench.Row,
    evaluator: _PhotoEvaluator,
    rendering: str | None,
    cut_photo: bytes,
    stored_photo: Mapping[str, JsonValue],
) -> workbench.Row:
    """Return a row with a model's prediction about a photograph.

    The name of the model is added to the row's values.

    Args:
        row: row with the values of the rendering, if there is one.
        evaluator: evaluator of the model.
        rendering: name of the rendering that the photograph was aligned with, if any.
        cut_photo: the cropped photograph, an image file as bytes.
        stored_photo: what is stored of the photograph in addition to the prediction.
    """
    # A sweep over several objects stores which one it was.
    object_name = None
    if "object" in row.values:
        object_name = str(row.values["object"]["value"])
    model_value: workbench.Value = {"value": evaluator.model.name, "unit": ""}
    row = replace(row, values={**row.values, "model": model_value})
    judgement = evaluator.evaluate(rendering, object_name, cut_photo)
    row = workbench.add_judgement(row, judgement)
    # The payload of the prediction, such as boxes, becomes a part of the row's payload.
    return replace(row, payload={"photo": dict(stored_photo), "answer": row.payload})


@dataclass(frozen=True)
class _PhotoEvaluator:
    """Evaluate photographs by one model of a run.

    Attributes:
        model: model that predicts.
        task: task that evaluates the prediction.
        size: (height, width) in pixels of the images that the model is run on.
        find_truth: returns the ground truth of a photograph by the name of its
            rendering (None if it was aligned with none) and the name of the object
            (None if the run has a single object).
        index: index of the model in the run.
        n_models: number of models in the run.
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

        It is resized in 8 bits with Lanczos' filter, which averages pixels when it
        shrinks an image.

        Args:
            rendering: name of the rendering that the image belongs to; None without.
            object_name: name of the object; None for the first one.
            data: the image file.
        """
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "WEBP")) as image:
            resized = image.convert("RGB").resize(
                self.size[::-1], Image.Resampling.LANCZOS
            )
        levels = np.asarray(resized, dtype=np.float32)
        pixels = torch.from_numpy(levels / np.float32(255.0))
        with torch.no_grad():
            output = self.model(pixels)
            truth = self.find_truth(rendering, object_name)
            return workbench.judge_images(self.task, output, pixels[None], [truth])[0]

    def evaluate_rendering(
        self, store: Store, rendering: str, file: Path
    ) -> tuple[bool, str, Mapping[str, workbench.Value]]:
        """Return whether a rendering is right, its label, and the values of its row.

        For a rendering of a sweep, they are read from the sweep's rows. For a rendering
        of an attack, the model is run on the image file, and there are no values.

        Args:
            store: stored rows of the run.
            rendering: name of the rendering: a number for a sweep, or a name such as
                "adversarial" for an attack.
            file: path of its image.

        Raises:
            InputError: the results have no row of a sweep's rendering.
        """
        is_of_sweep = rendering.isdecimal()
        if is_of_sweep:
            # Rows are numbered by image, then by model.
            step = int(rendering) * self.n_models + self.index
            row = store.read_row("sweep", step)
            if row is not None:
                return bool(row.correct), row.label or "", row.values
        # An attack stores its renderings as PNG, a sweep as JPEG.
        is_of_attack = file.suffix == ".png"
        if not is_of_attack:  # a rendering of a sweep, which has no row
            raise InputError(
                f"rendering: the results have no row for {file.stem}; it "
                "belongs to another run"
            )
        # None: an attack has one object, so that its name is not needed.
        judgement = self.evaluate(rendering, None, file.read_bytes())
        return judgement.right, judgement.prediction.label, {}


def _load_evaluators(run: Path) -> list[_PhotoEvaluator]:
    """Load the evaluators of photographs of a run, one for each of its models.

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

    If the ground truth does not depend on the configuration, or no image is named, it
    is the ground truth of the object.

    Args:
        sweep: the loaded scenes (`SceneLoader`).
        model_index: index of the model.
        image_number: number of the image as text; None for a photograph that was
            aligned with none.
        object_name: name of the object. Without a scene of this name, the first scene
            is used: rows state the object only if the sweep has several.

    Raises:
        InputError: the sweep has no such image.
    """
    job = sweep.job
    task = job.tasks[model_index]
    if image_number is None or not _needs_position(task):
        scene = _find_scene_of_object(job, object_name)
        # The ground truth needs no values of the configuration.
        return task.truth(job.make_ground_truth_facts(scene, {}))
    number = int(image_number)
    if number >= job.images_per_scene * len(job.scenes):
        raise InputError(
            f"rendering: the sweep has no picture {image_number}; it "
            "belongs to another run"
        )
    scene, queries = sweep.make_queries(number)  # a query for each model
    query = queries[model_index]
    return scene.problems[model_index].find_truth(query.u, query.values)


def _find_scene_of_object(job: Any, object_name: str | None) -> Any:
    """Return the scene of an object; the first scene if none has this object."""
    matching = (scene for scene in job.scenes if scene.object_name == object_name)
    return next(matching, job.scenes[0])


def _load_attack_evaluators(run: Path, config: AttackConfig) -> list[_PhotoEvaluator]:
    """Load the models of an attack, with the ground truth of its images.

    An attack on an ensemble has several models; each gets an evaluator.
    """
    # The second value is the loaded configuration, which is not needed here.
    problem, _ = workbench.problem_from_config(workbench.with_evaluation_only(config))
    models: list[tuple[Model, Task]] = [(problem.model, problem.task)]
    if isinstance(problem.task, workbench.EnsembleTask):
        models = list(zip(problem.task.models, problem.task.tasks, strict=True))
    return [
        _PhotoEvaluator(
            model=model,
            task=task,
            size=config.resolution or model.input_size,
            # the remaining arguments are the names of the rendering and the object
            find_truth=partial(_find_attack_truth, run, problem, task),
            index=index,
            n_models=len(models),
        )
        for index, (model, task) in enumerate(models)
    ]


def _find_attack_truth(
    run: Path, problem: Problem, task: Task, rendering: str | None, _object: str | None
) -> workbench.Truth:
    """Return the ground truth of the clean or adversarial scene, or of a trial.

    Args:
        run: the directory of the attack.
        problem: problem of the attack.
        task: task of a model.
        rendering: "clean", "adversarial" or "verification-NUMBER", which is a trial of
            the adversarial scene; None for a photograph without a rendering, which has
            the truth of the clean scene.
        _object: not used, as an attack has one object.
    """
    u = problem.domain.start  # the clean scene
    is_adversarial = rendering not in (None, "clean")
    # If the truth does not depend on the configuration, the clean scene's is the same.
    if is_adversarial and _needs_position(task):
        u = workbench.read_stored_configuration(run, problem)
    seed = _find_trial_seed(problem.seed, rendering or "")
    configuration = problem.make_full_configuration(u, seed)
    facts = problem.make_facts(
        lambda: problem.space.describe(configuration),
        lambda: problem.renderer.find_surfaces(configuration),
    )
    return task.truth(facts)


def _find_trial_seed(problem_seed: int, rendering: str) -> int | None:
    """Return the seed of the conditions that a rendering has.

    A trial has the conditions that its seed draws. Other renderings have those of the
    scene, for which the seed is None.
    """
    # Other names do not have "verification-": then `rpartition` returns the full name,
    # which is no number.
    _, _, trial_number = rendering.rpartition("verification-")
    if trial_number.isdecimal():
        return seeds.derive_seed(problem_seed, "verification", int(trial_number))
    return None
