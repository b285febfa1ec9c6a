"""The loop of a sweep: evaluate every row, store and count predictions, summarize.

Rows are numbered by scene (all clean scenes before the adversarial ones), then by point
of the grid with its last axis fastest, then by draw, then by model. A batch begins at a
multiple of its size, so that the result is bit for bit the same if a sweep is stopped
and continued, or if its batches come in another order.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from advsearch.attacks import Evaluation, Query
from advsearch.attacks.domain import split_into_batches
from advsearch.cluster import BatchResult, InProcess, Workers
from advsearch.engine.journal import (
    Journal,
    ParallelEvaluator,
    WorkItem,
    make_lost_evaluation,
    make_worker_call,
)
from advsearch.engine.loading import fit_camera
from advsearch.engine.problem import Problem
from advsearch.engine.record import LOST_LABEL, make_lost_remarks, read_judgement
from advsearch.interrupts import reraise_lost_interrupt
from advsearch.options import OUT_OF_VIEW
from advsearch.progress import Progress, Stages
from advsearch.questions.attack.result import save_with_marks
from advsearch.questions.sweep.display import draw_sweep
from advsearch.questions.sweep.drives import Drives, find_time_axis
from advsearch.questions.sweep.job import (
    KIND,
    Job,
    SceneLoader,
    check_job,
    verify_worst,
)
from advsearch.questions.sweep.page import write_sweep_page
from advsearch.questions.sweep.predicting import combine_transport
from advsearch.questions.sweep.result import (
    FINISHED,
    Predictions,
    SweepResult,
    TableAxis,
    count_predictions,
    make_map,
)
from advsearch.questions.sweep.settings import BLIND
from advsearch.questions.sweep.summary import (
    ArmComparison,
    AxisRow,
    ChangeRates,
    DriveRates,
    SurfaceMap,
    SweepSummary,
    WorstClaim,
    WorstConfiguration,
    WorstVerified,
)
from advsearch.questions.sweep.surface import map_surface
from advsearch.report.wording import explain_repeats, format_count
from advsearch.runs.directory import AOV_FOLDER, RunDirectory
from advsearch.runs.files import write_layers
from advsearch.runs.results import (
    INTERRUPTED,
    DescribedValue,
    Formation,
    LinearTransport,
    SharedWork,
    TwinEvidence,
)
from advsearch.runs.store import Row
from advsearch.runs.tables import EDGES_NOTE, UNITS_NOTE
from advsearch.runs.twins import find_twin_evidence
from advsearch.statistics.clustered import max_lower_bound
from advsearch.tasks import Judgement
from advsearch.trust.writing import write_bytes
from advsearch.viewer import thumbnails

# the note in the store that some values of images were not finite
NOT_FINITE = "pictures not finite"
# samples per pixel of the image that is saved, unless verification needed more
SAVED_IMAGE_SPP = 64
ENOUGH_DRIVES = 20  # with fewer, a remark states what they can show at best
REPORT_SECONDS = 0.1  # progress is reported at most once in this time
MAX_LISTED_GAINS = 256  # a summary of more scenes lists no gains
SAMPLING_BATCH = 4096  # number of images whose draws are computed at once for tables


class Sweep:
    """One sweep, from its first row or from where it was stopped.

    Args:
        job: what is swept.
        run: the run directory, with the rows that are stored already; None keeps all
            in memory.
        progress: reports the progress.
        executor: evaluates the batches; None evaluates them in this process.

    Rows are numbered by image, then by model.

    Attributes:
        first_scene_configurations: the configurations of the first scene.
        images_per_scene: number of images of a scene.
        n_models: number of models, all of which predict every image.
        independent_units: the independent units that rows belong to: rows of the same draw share
            one.
        n_rows: number of rows of the full sweep.
    """

    def __init__(
        self,
        job: Job,
        run: RunDirectory | None,
        progress: Progress,
        executor: Workers | None = None,
    ) -> None:
        """Check the job and store what readers of the rows need; see the class."""
        self.job = job
        self.run = run
        self.stages = Stages(progress)
        self.stages.begin("setup", "preparing the scenes for rendering")
        self.first_scene_configurations, self._sampled_numbers = check_job(job)
        self.images_per_scene = self.first_scene_configurations.n_images
        self.n_models = len(job.models)
        self.independent_units = replace(
            self.first_scene_configurations.independent_units, models=self.n_models
        )
        self.n_rows = len(job.scenes) * self.images_per_scene * self.n_models
        if run is not None:
            self._write_notes(run)
        self._scenes = SceneLoader(job)
        self._executor = self._make_in_process() if executor is None else executor
        # Problems are loaded by the name of the scene in each work item.
        self.journal = Journal(run, ParallelEvaluator(None, executor))
        self._reset_counts()
        self._reset_progress()
        # Summaries of the predictors of images, by worker and scene. There is one for
        # each size of images; None if nothing that they predict moves.
        self._transport: dict[tuple[str, int], list[LinearTransport | None]] = {}
        self._has_non_finite = _has_stored_non_finite(run)
        self._surface: SurfaceMap | None = None
        self._drives: list[DriveRates] | None = None

    def _make_in_process(self) -> Workers:
        """Return what evaluates batches in this process."""
        return InProcess(make_worker_call(self._scenes.load_by_name))

    def _reset_progress(self) -> None:
        """Set what is counted for the progress since this sweep was resumed to 0."""
        self._n_rendered = 0  # images, also predicted ones
        self._sweep_begin = 0.0
        self._last_report = 0.0
        self._n_unreported = 0

    def _reset_counts(self) -> None:
        """Set the counts of the full sweep to 0, also of what was done before a stop."""
        self._n_traced = 0  # images that were traced, also to prepare predictors
        self._n_predicted = 0  # images that were predicted from traced ones
        self._n_lost = 0  # rows that have no prediction, since their worker died

    def _write_notes(self, run: RunDirectory) -> None:
        """Store the parts of ranges and the independent units, which readers need."""
        bounds_by_name = {
            number.name: number.part_bounds
            for number in self._sampled_numbers
            if number.part_bounds
        }
        run.store.write_note(EDGES_NOTE, json.dumps(bounds_by_name))
        run.store.write_note(UNITS_NOTE, json.dumps(asdict(self.independent_units)))

    def execute(self) -> SweepResult:
        """Evaluate the rows that are not stored yet, and return the result."""
        predictions = self._read_predictions()
        ending = FINISHED
        for warning in self.job.warnings:
            self.stages.progress.message(warning)
        try:
            with reraise_lost_interrupt():
                self._evaluate_missing(predictions)
                worst = self._find_worst(predictions, verify=True)
                self._map_surface()
                self._analyze_drives()
        except KeyboardInterrupt:
            ending = INTERRUPTED
            # A batch may have been stored but not yet counted: so all are read again.
            predictions = self._read_predictions()
            worst = self._find_worst(predictions, verify=False)
        self.stages.end()
        return self._finish(predictions, ending, worst)

    def _evaluate_missing(self, predictions: Predictions) -> None:
        """Evaluate the rows that are not stored yet, and add their predictions."""
        missing = self._find_missing()
        # If no row is missing, the last scene is loaded: verifying the worst row and
        # describing the image formation need a scene.
        first_row = missing[0].start if missing else self.n_rows - 1
        # loaded here, so that its time counts for the stage "setup"
        self._scenes.load_scene(self._find_scene(first_row))
        self._evaluate_rows(missing, predictions)

    def _map_surface(self) -> None:
        """Map wrong predictions over the surface, if that was requested."""
        if not self.job.config.surface or self.run is None:
            return
        self.stages.begin("surface", "tracing the surface that was seen", self.n_rows)
        self._surface = map_surface(
            self._scenes, self.iterate_rows(), self.run, self.stages.progress
        )

    def _analyze_drives(self) -> None:
        """Compute the rates over drives, if the frames of a path are swept."""
        has_frames = find_time_axis(self.job.axes) is not None
        if not has_frames:
            return
        self.stages.begin("drives", "rendering the frames of the worst drive")
        drives = Drives(self.job, self.iterate_rows())
        if self.run is not None:
            drives.save_worst(self._scenes, self.run)
        self._drives = drives.compute_rates()

    def _find_scene(self, row: int) -> int:
        """Return the index of the scene of a row."""
        return row // self.n_models // self.images_per_scene

    def _find_missing(self) -> list[range]:
        """Return the numbers of the rows that are not stored."""
        if self.run is None:
            return [range(self.n_rows)]
        return list(self.run.store.find_missing_steps(KIND, self.n_rows))

    def _evaluate_rows(
        self, missing: Sequence[range], predictions: Predictions
    ) -> None:
        """Evaluate rows in batches; store and count their predictions.

        Args:
            missing: numbers of the rows that are not stored yet.
            predictions: predictions so far; those of the new rows are added.
        """
        title = "rendering and classifying"
        self.stages.begin("sweep", title, self.n_rows, hint=self._make_progress_hint())
        self.stages.progress.advance(self.n_rows - sum(map(len, missing)))
        self._sweep_begin = time.monotonic()
        batches = self._make_batches(missing)
        for batch in self._executor.compute(batches):
            evaluated = _pair_evaluations(batch)
            self._store_batch(evaluated, batch.worker)
            for query, evaluation in evaluated:
                predictions.add(query.row_index, evaluation.required_judgement)
            self._report(len(evaluated), predictions)
        # Workers may finish batches in any order.
        self.journal.rows.sort(key=lambda row: row.step)

    def _store_batch(
        self, evaluated: Sequence[tuple[Query, Evaluation]], worker: str
    ) -> None:
        """Store the evaluations of a batch, and count what they cost.

        Args:
            evaluated: queries of one scene with their evaluations.
            worker: name of the worker that evaluated them.
        """
        self._save_images(evaluated)
        # The index of a query is the number of its row.
        stored_rows = self.journal.store(evaluated, id_is_number=True)
        self._add_costs(stored_rows)
        # Models of one size share an image, which counts for the first of them.
        model_indices = [query.row_index % self.n_models for query, _ in evaluated]
        self._n_rendered += sum(
            self.job.is_first_of_size[model] for model in model_indices
        )
        first_query, _ = evaluated[0]
        scene = self._find_scene(first_query.row_index)
        # Summaries of predictors are in the last evaluation of a batch. A later batch of
        # the same worker and scene replaces them.
        _, last_evaluation = evaluated[-1]
        self._transport[worker, scene] = last_evaluation.collected_light or []
        if any(evaluation.n_non_finite for _, evaluation in evaluated):
            self._note_non_finite()

    def _make_progress_hint(self) -> str:
        """Return the hint of the progress bar about the work ahead.

        That is the number of predictions, and about how much disk space the stored
        thumbnails will take.
        """
        hint = (
            f"{self.n_rows} predictions, pictures of "
            f"{format_count(self.job.spp, 'sample')} "
            "a pixel; `resolution`, `spp` or fewer points shorten it"
        )
        keep = self.job.config.keep_pictures
        if self.run is None or keep == "none":
            return hint
        size = _format_megabytes(self._estimate_thumbnail_megabytes())
        # Unless all are stored, only those of wrong predictions are.
        about = "about" if keep == "all" else "at most about"
        return f"{hint}; pictures that are kept take {about} {size}"

    def _estimate_thumbnail_megabytes(self) -> float:
        """Estimate the size of the thumbnails of all images, of the first model."""
        height, width = self.job.image_sizes[0]
        # A thumbnail is at most THUMBNAIL_SIZE wide and high, and never enlarged.
        scale = min(1.0, thumbnails.THUMBNAIL_SIZE / max(height, width))
        n_pixels = scale**2 * height * width
        fraction_of_typical = n_pixels / thumbnails.THUMBNAIL_SIZE**2
        n_images = self.n_rows // self.n_models
        return n_images * thumbnails.TYPICAL_BYTES * fraction_of_typical / 1e6

    def _save_images(self, evaluated: Sequence[tuple[Query, Evaluation]]) -> None:
        """Save thumbnails and layers that evaluations have, in the run directory."""
        if self.run is None:
            return
        for query, evaluation in evaluated:
            number = query.row_index // self.n_models
            if evaluation.jpeg is not None:
                thumbnails.write_thumbnail(self.run.path, number, evaluation.jpeg)
            if evaluation.layers is not None:
                file = self.run.path / AOV_FOLDER / f"{number:06d}.exr"
                write_layers(file, *evaluation.layers)

    def _note_non_finite(self) -> None:
        """Note that some values of images were not finite."""
        if self._has_non_finite:
            return
        self._has_non_finite = True
        if self.run is not None:
            self.run.store.write_note(NOT_FINITE, "yes")

    def _make_batches(self, missing: Sequence[range]) -> Iterator[list[WorkItem]]:
        """Yield the queries of missing rows in batches, none over two scenes.

        A batch begins at a multiple of its size in the scene, whatever is missing, so
        that its evaluations don't depend on where a sweep was stopped. If only some
        rows of an image are missing, only these are yielded.

        Args:
            missing: ranges of row numbers; a row is an image and a model.
        """
        for rows in missing:
            for images in self._split_images(rows):
                items = self.job.make_queries(images)
                yield [
                    (problem_name, u, query)
                    for problem_name, u, query in items
                    if query.row_index in rows
                ]

    def _split_images(self, rows: range) -> Iterator[range]:
        """Yield the images of a range of rows in batches, each within one scene."""
        image = rows.start // self.n_models
        images_end = -(-rows.stop // self.n_models)  # rounded up
        while image < images_end:
            scene_begin = image // self.images_per_scene * self.images_per_scene
            scene_end = scene_begin + self.images_per_scene
            end = min(images_end, scene_end)
            # Batches begin at multiples of their size, counted from the scene's begin.
            batches = split_into_batches(
                image - scene_begin, end - scene_begin, self.job.config.batch
            )
            for batch in batches:
                yield range(scene_begin + batch.start, scene_begin + batch.stop)
            image = scene_end

    def _report(self, n_rows: int, predictions: Predictions) -> None:
        """Report progress by some rows, at most every `REPORT_SECONDS`.

        Args:
            n_rows: rows that were evaluated since the last call.
            predictions: predictions so far, of which the accuracy is reported.
        """
        self._n_unreported += n_rows
        now = time.monotonic()
        if now - self._last_report < REPORT_SECONDS:
            return
        values = self._make_progress_values(predictions, now)
        self.stages.progress.advance(self._n_unreported, **values)
        self._last_report = now
        self._n_unreported = 0

    def _make_progress_values(
        self, predictions: Predictions, now: float
    ) -> dict[str, float | str]:
        """Return the accuracy so far, and what the workers do; empty if unknown.

        Args:
            predictions: predictions so far.
            now: seconds of the monotonic clock.
        """
        values = dict[str, float | str]()
        n_counted = int(predictions.is_counted.sum())
        if n_counted:
            n_right = int((predictions.is_right & predictions.is_counted).sum())
            values["accuracy"] = n_right / n_counted
        worker_stats = self._executor.stats
        if worker_stats is not None:
            seconds = max(1e-9, now - self._sweep_begin)  # no division by 0
            speed = self._n_rendered / seconds
            values |= {**worker_stats.progress_counts, "a second": speed}
        return values

    def _read_predictions(self) -> Predictions:
        """Read the predictions of all rows so far, and count their costs anew."""
        predictions = Predictions(self.n_rows)
        self._reset_counts()
        for row in self.iterate_rows():
            predictions.add(row.step, read_judgement(row))
            self._add_costs([row])
        return predictions

    def iterate_rows(self) -> Iterable[Row]:
        """Return all rows so far."""
        return self.journal.rows if self.run is None else self.run.store.rows(KIND)

    def _add_costs(self, rows: Sequence[Row]) -> None:
        """Count the traced and the predicted images of rows, and the lost rows.

        Models of one image size share an image, which counts for the first of them.
        """
        for row in rows:
            is_first_of_size = self.job.is_first_of_size[row.step % self.n_models]
            if row.renders is not None:
                self._n_traced += row.renders  # 0 for models that share an image
            elif is_first_of_size:  # rows of old versions don't state their renders
                self._n_traced += 1
            # The seed is that of the noise. A predicted image has no noise.
            was_predicted = row.seed is None
            if was_predicted and is_first_of_size:
                self._n_predicted += 1
            if row.label == LOST_LABEL:
                self._n_lost += 1

    def _make_axes(self, rows: npt.NDArray[np.int64]) -> list[TableAxis]:
        """Return the axes by whose values tables count predictions.

        These are object, environment, photograph, clean or adversarial scene, model,
        the axes of the grid, and the sampled numbers, whose ranges are divided into
        parts. Axes with a single value are left out.

        Args:
            rows: (n,) numbers of the rows, ascending, whose values are looked up.
        """
        image, model = np.divmod(rows, self.n_models)
        scene, image_in_scene = np.divmod(image, self.images_per_scene)
        model_names = [network.name for network in self.job.models]
        axes = [
            *self._make_scene_axes(scene),
            TableAxis("model", "", model_names, value_index=model),
            *self._make_grid_axes(image_in_scene),
        ]
        if self._sampled_numbers and len(rows):
            axes += self._make_sampled_axes(image)
        return [axis for axis in axes if len(axis.values) > 1]

    def _make_sampled_axes(self, image: npt.NDArray[np.int64]) -> list[TableAxis]:
        """Return the axes of the sampled numbers.

        Args:
            image: (n,) number of the image of each row, in the sweep.
        """
        parts = self._find_parts(image)  # (n, k)
        return [
            TableAxis(
                name=number.name,
                unit=number.unit,
                values=number.range_parts,
                value_index=part_of_row,
                kind="drawn",
            )
            for number, part_of_row in zip(self._sampled_numbers, parts.T, strict=True)
        ]

    def _make_scene_axes(self, scene: npt.NDArray[np.int64]) -> Iterator[TableAxis]:
        """Yield the axes over scenes: object, environment, photograph, arm.

        Args:
            scene: (n,) index of the scene of each row.
        """
        for name in ("object", "environment", "backdrop", "answer"):
            scene_values = [
                named_scene.value_of_scene_axis.get(name, "")
                for named_scene in self.job.scenes
            ]
            values = list(dict.fromkeys(scene_values))
            index_of_scene = np.array([values.index(value) for value in scene_values])
            yield TableAxis(name, "", values, index_of_scene[scene])

    def _make_grid_axes(self, image: npt.NDArray[np.int64]) -> list[TableAxis]:
        """Return the axes of the grid.

        Args:
            image: (n,) number of the image of each row, in its scene.
        """
        if not self.job.axes:
            return []
        # The samples of a grid point are consecutive images.
        grid_point = image // self.job.samples_per_grid_point
        grid = self.first_scene_configurations.grid
        indices = np.unravel_index(grid_point, grid.sizes)
        return [
            TableAxis(
                name=axis.name,
                unit=axis.unit,
                values=axis.values,
                value_index=value_indices,
                kind="grid",
            )
            for axis, value_indices in zip(self.job.axes, indices, strict=True)
        ]

    def _find_parts(self, images: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return the index of the part that each of k sampled numbers is in, (n, k).

        They are computed for all images up to the last one, in batches of consecutive
        images, since draws are a sequence. The sequence goes on through all scenes.

        Args:
            images: (n,) their numbers in the sweep, ascending, at least one.
        """
        last_image = int(images[-1])
        configurations = self.first_scene_configurations
        parts = list[npt.NDArray[np.int64]]()
        for scene_begin in range(0, last_image + 1, self.images_per_scene):
            scene_end = scene_begin + self.images_per_scene
            for batch in split_into_batches(scene_begin, scene_end, SAMPLING_BATCH):
                if batch.start <= last_image:
                    parts.append(configurations.find_parts(batch.start, len(batch)))
        return np.asarray(np.concatenate(parts)[images])

    def _find_worst(
        self, predictions: Predictions, *, verify: bool = False
    ) -> WorstConfiguration | None:
        """Return the configuration with the smallest margin; None if there is none.

        What the sweep predicted (`claimed`) comes from the stored row. Values, seed and
        right labels come from the query, which follows from the number of the row.

        Args:
            predictions: predictions of all rows.
            verify: whether to render it again, and save its image.
        """
        row_number = predictions.worst_row
        if row_number is None:
            return None
        model = row_number % self.n_models
        claim = _make_claim(read_judgement(self._read_row(row_number)))
        query = self._make_query_of_row(row_number)
        scene = self._find_scene(row_number)
        worst = WorstConfiguration(
            configuration=row_number,
            values=_describe_values(query),
            seed=query.seed,
            label_set=self._find_right_labels(scene, model, query),
            claimed=claim,
            verified=None,
        )
        if not verify:
            return worst
        problem = self._scenes.load_scene(scene).problems[model]
        return self._verify_worst(worst, problem, query.u)

    def _make_query_of_row(self, number: int) -> Query:
        """Return the query that a row, by its number, stores the result of."""
        image, model = divmod(number, self.n_models)
        item_of_model = self.job.make_queries(range(image, image + 1))
        _, _, query = item_of_model[model]  # an item ends with its query
        return query

    def _read_row(self, number: int) -> Row:
        """Return a row that was evaluated, from the run directory if there is one."""
        rows: Iterable[Row | None] = self.journal.rows
        if self.run is not None:
            rows = [self.run.store.read_row(KIND, number)]
        return next(row for row in rows if row is not None and row.step == number)

    def _find_right_labels(self, scene: int, model: int, query: Query) -> list[str]:
        """Return the names that count as right in the image of a query."""
        task = self.job.tasks[model]
        if task.varies:  # the truth depends on the configuration, as a box does
            problem = self._scenes.load_scene(scene).problems[model]
            truth = problem.find_truth(query.u, query.values)
        else:
            # The facts of the scene are enough, so that it need not be loaded.
            named_scene = self.job.scenes[scene]
            facts = self.job.make_ground_truth_facts(named_scene, query.values)
            truth = task.truth(facts)
        return list(task.truth_names(truth))

    def _verify_worst(
        self, worst: WorstConfiguration, problem: Problem, u: Tensor
    ) -> WorstConfiguration:
        """Render the worst configuration again, and save its image.

        Args:
            worst: the configuration, as the sweep evaluated it.
            problem: problem of its scene and model.
            u: (d,) the configuration.
        """
        verified = verify_worst(problem, self.job.config, u, self.run, self.stages)
        if self.run is None:
            return worst.model_copy(update={"verified": verified})
        verified_spp = verified.spp if verified else 0
        saved_spp = max(SAVED_IMAGE_SPP, verified_spp)
        image = problem.picture(u, worst.seed, saved_spp)
        self.run.save_image("worst", image)
        # a second file, with the marks of the task, such as boxes
        save_with_marks(self.run, "worst", image, problem.find_marks(image, u))
        # The saved image has more samples per pixel than that of the sweep, so that the
        # prediction about it may be another.
        image_claim = _make_claim(problem.judge(image, u))
        return worst.model_copy(update={"verified": verified, "pictured": image_claim})

    def _finish(
        self, predictions: Predictions, ending: str, worst: WorstConfiguration | None
    ) -> SweepResult:
        """Summarize the sweep, write its files, and return the result.

        Args:
            predictions: predictions of all rows so far.
            ending: how the sweep ended, such as "finished".
            worst: the configuration with the smallest margin; None without one.
        """
        summary = self._summarize(predictions, ending, worst)
        if self.run is not None:
            for suffix, data in draw_sweep(summary).items():
                write_bytes(self.run.path / "images" / f"sweep.{suffix}", data)
            write_sweep_page(self.run.path, summary)
            # The summary comes last: without a page the run has not finished.
            self.run.write_summary(summary)
        path = None if self.run is None else self.run.path
        return SweepResult(summary, path, tuple(self.journal.rows))

    def _summarize(
        self, predictions: Predictions, ending: str, worst: WorstConfiguration | None
    ) -> SweepSummary:
        """Return the summary, which is stored as `summary.json`.

        Args:
            predictions: predictions of all rows so far.
            ending: how the sweep ended.
            worst: the configuration with the smallest margin; None without one.
        """
        config = self.job.config
        path = None if self.run is None else self.run.path
        # the rate of wrong predictions in fresh renders
        verified = worst.verified if worst else None
        changes = self._compute_change_rates()
        remarks = self._list_remarks(predictions, verified, changes)
        return SweepSummary(
            **self._summarize_job(),
            **self._summarize_predictions(predictions),
            **self._summarize_renders(verified),
            run=None if path is None else str(path),
            ending=ending,
            worst=worst,
            surface=self._surface,
            drives=self._drives,
            changes=changes or None,
            seconds={**self.stages.seconds, "total": self.stages.total_seconds},
            warnings=[*self.job.warnings, *remarks],
            command_line=config.command_line(path),
            python_only=config.python_only,
            twins=self._find_twins(),
        )

    def _summarize_renders(self, verified: WorstVerified | None) -> dict[str, Any]:
        """Return the fields of a summary about how images were made, and by whom.

        Args:
            verified: fresh renders of the worst configuration; None without them.
        """
        formation, gains = self._describe_formation()
        sweep_seconds = self.stages.seconds.get("sweep", 0.0)
        return {
            "image_formation": formation,
            "gains": gains if len(gains) > 1 else None,
            "renders": self._count_renders(verified),
            "transport": self._combine_transport(),
            "shared": SharedWork.from_worker_stats(
                self._executor.stats, self.journal.machines
            ),
            "renders_per_second": self._compute_speed(sweep_seconds),
        }

    def _summarize_job(self) -> dict[str, Any]:
        """Return the fields of a summary about what was swept."""
        job = self.job
        config = job.config
        is_sampled = self.first_scene_configurations.is_sampled
        ranges = {number.name: number.varied_value for number in self._sampled_numbers}
        return {
            "object": config.object,
            "model": ",".join(_get_names(job.models)),
            "task": config.task_name,
            "environment": self._environment,
            "controls": _get_names(job.controls),
            "drawn": ranges,
            "planned": self.n_rows,
            "grid": {axis.name: len(axis.values) for axis in job.axes},
            "samples": job.samples_per_grid_point,
            "sampler": config.sampler if is_sampled else None,
            "spp": job.spp,
            "seed": config.seed,
        }

    def _summarize_predictions(self, predictions: Predictions) -> dict[str, Any]:
        """Return the fields of a summary that count the predictions of rows so far."""
        # Accuracies count rows. Their intervals count independent units: the frames of
        # a drive, for example, are not independent, and are one unit.
        rows = np.flatnonzero(predictions.is_counted)
        right = predictions.is_right[rows]
        units = self.independent_units.find_unit(rows)
        outcome = predictions.outcome[rows]
        axes = self._make_axes(rows)
        # If every row is a unit, the summary states no number of units.
        has_shared_units = self.independent_units.size > 1 and len(units) > 0
        return {
            **vars(count_predictions(right, units, outcome)),
            "out_of_view": int(predictions.is_out_of_view.sum()),
            "phantoms_out_of_view": predictions.n_phantoms_out_of_view,
            "units": len(np.unique(units)) if has_shared_units else None,
            "not_finite": predictions.n_non_finite,
            "answers": predictions.frequent_wrong_labels,
            "axes": _make_axis_rows(axes, right, units, outcome),
            "cells": make_map(axes, right, predictions.margin[rows]),
            "arms": self._compare_arms(predictions),
        }

    @property
    def _environment(self) -> str:
        """Names of the environments: those a control chooses, or those of settings."""
        return (
            self.first_scene_configurations.environment
            or self.job.config.environment_name
        )

    def _find_twins(self) -> TwinEvidence | None:
        """Return how far results on renders hold for photographs.

        The evidence is a run that compared renders with photographs of the same scenes
        (setting `twins`). None without such a run.
        """
        config = self.job.config
        return find_twin_evidence(
            config.twins,
            model=",".join(_get_names(self.job.models)),
            task=config.task_name,
            object_name=config.object,
            environment=self._environment,
            in_photograph=getattr(config, "backdrop", None) is not None,
        )

    def _describe_formation(self) -> tuple[Formation | None, dict[str, float]]:
        """Return how images are formed, and the gain of each scene by its names.

        The gain is the factor of exposure on linear pixel values. If all scenes have
        the same gain, the formation states it. With more than `MAX_LISTED_GAINS`
        scenes, there are no gains, and the formation states none either. If no scene
        was loaded, the formation is None.
        """
        if self._scenes.loaded_scene is None:
            return None, {}
        # Formations of other sizes differ only in the resolution.
        renderer = next(iter(self._scenes.loaded_scene.renderer_of_size.values()))
        formation = Formation.from_values(renderer.formation)
        gains: dict[str, float] = {}
        if len(self.job.scenes) <= MAX_LISTED_GAINS:
            gains = self._list_scene_gains()
        have_same_gain = len(set(gains.values())) == 1  # False without gains
        if not have_same_gain:
            formation = formation.model_copy(update={"gain": None})
        return formation, gains

    def _list_scene_gains(self) -> dict[str, float]:
        """Return the gain of each scene, the factor of its exposure, by its names."""
        gains: dict[str, float] = {}
        for named_scene in self.job.scenes:
            description = fit_camera(
                named_scene.scene.description, self.job.image_sizes[0]
            )
            names = dict(named_scene.value_of_scene_axis)
            # The adversarial scene has the gain of its clean scene.
            names.pop("answer", None)  # the name of the arm
            gains[", ".join(names.values())] = description.gain
        return gains

    def _compare_arms(self, predictions: Predictions) -> ArmComparison | None:
        """Compare the clean scenes with the adversarial ones; None without any."""
        # The adversarial scenes come last. Their arm is named after the attack's run.
        adversarial_run = self.job.scenes[-1].arm
        if not adversarial_run:
            return None
        models = [model.name for model in self.job.models]
        pairs = predictions.compare_arms(models, self.independent_units)
        return ArmComparison(adversarial_run=adversarial_run, pairs=pairs)

    def _count_renders(self, verified: WorstVerified | None) -> dict[str, int]:
        """Return how many images were traced, and how many predicted instead."""
        n_verification = verified.renders if verified else 0
        renders = {"sweep": self._n_traced, "verification": n_verification}
        if self._n_predicted:
            renders["products"] = self._n_predicted
        return renders

    def _combine_transport(self) -> LinearTransport | None:
        """Return the summary of predicted images, over all workers and scenes."""
        transport = [
            summary for summaries in self._transport.values() for summary in summaries
        ]
        # A continued sweep may have had no batch left to evaluate. Then the predictors
        # of the loaded scene state what they would do.
        if not self._transport and self._scenes.loaded_scene is not None:
            predictors = self._scenes.loaded_scene.predictor_of_size.values()
            transport = [predictor.summarize() for predictor in predictors]
        return combine_transport(transport)

    def _compute_speed(self, sweep_seconds: float) -> float | None:
        """Return rendered images a second; None if none was rendered now."""
        if not self._n_rendered or not sweep_seconds:
            return None
        return self._n_rendered / sweep_seconds

    def _compute_change_rates(self) -> list[ChangeRates]:
        """Return how often predictions about changed images meet each claim.

        A claim is that the prediction must change, or must not change, if the image is
        changed in some way, for example `must_change` with the object hidden. Each row
        has a metric for it: 1 if its prediction meets the claim, else 0. There is a
        rate for each claim, change and model. Rows without the object do not count.
        """
        rates = list[ChangeRates]()
        for claim, change in self.job.config.claims:
            metric = f"{claim} {change}"
            value_of_row = {
                row.step: row.metrics[metric]
                for row in self.iterate_rows()
                if row.label != OUT_OF_VIEW and metric in row.metrics
            }
            for model in range(self.n_models):
                rate = self._compute_change_rate(value_of_row, model, claim, change)
                rates.append(rate)
        return rates

    def _compute_change_rate(
        self,
        value_of_row: Mapping[int, float | None],
        model: int,
        claim: str,
        change: str,
    ) -> ChangeRates:
        """Return how often the predictions of a model meet a claim.

        The returned `row` is the first row whose prediction does not meet it.

        Args:
            value_of_row: the claim's metric by the number of the row: 1 if the
                prediction meets the claim, else 0.
            model: index of the model.
            claim: name of the claim, such as "must_change".
            change: name of the change of the image, such as "black".
        """
        row_numbers = [row for row in value_of_row if row % self.n_models == model]
        rows = np.array(row_numbers, dtype=np.int64)
        is_met = np.array([value_of_row[row] == 1.0 for row in row_numbers], dtype=bool)
        violations = rows[~is_met]
        units = self.independent_units.find_unit(rows)
        return ChangeRates(
            **vars(count_predictions(is_met, units)),
            model=self.job.models[model].name,
            claim=claim,
            when=change,
            row=int(violations[0]) if len(violations) else None,
        )

    def _list_remarks(
        self,
        predictions: Predictions,
        verified: WorstVerified | None,
        changes: Sequence[ChangeRates],
    ) -> Iterator[str]:
        """Yield remarks that limit the result, or state what is unusual in it.

        Args:
            predictions: predictions of all rows so far.
            verified: fresh renders of the worst configuration; None without them.
            changes: how often predictions about changed images meet the claims.
        """
        yield from make_lost_remarks(self._n_lost)
        yield from self.journal.remarks
        yield from self._list_repeat_remarks()
        yield from self._list_drive_remarks()
        yield from self._list_prediction_remarks(predictions)
        if self._has_non_finite:
            yield "Some values of pictures were not finite and were set to 0."
        if verified and not verified.converged:
            yield _make_noise_remark(verified.spp)
        for rates in changes:
            if _is_blind(rates):
                yield _make_blind_remark(rates)

    def _list_repeat_remarks(self) -> Iterator[str]:
        """Yield a remark on images that differ only in noise."""
        units = self.independent_units
        n_repeats = units.noise
        # With a folder of photographs, a unit is a photograph, and not such images.
        if n_repeats > 1 and units.photographs == 1:
            n_units = self.n_rows // units.size
            yield explain_repeats(units.name, n_repeats, n_units)

    def _list_drive_remarks(self) -> Iterator[str]:
        """Yield a remark on what few drives can show at best.

        The sentence states the lower bound of the accuracy that so few drives would
        have even if every frame were right.
        """
        if not self._drives:
            return
        # the number of the model with the fewest drives
        n_drives = min(rates.drives for rates in self._drives)
        # Then `explain_repeats` has stated that there is one drive.
        is_repeated = self.independent_units.noise > 1
        if n_drives == 1 and not is_repeated:
            yield "One drive says nothing of others: there is no interval over drives."
        elif 1 < n_drives < ENOUGH_DRIVES:
            lower_bound = max_lower_bound(n_drives)
            yield (
                f"{format_count(n_drives, 'drive')} can show little: were the model "
                "right in all their frames, the interval of "
                f"that share would begin at {100 * lower_bound:.0f} %."
            )

    def _list_prediction_remarks(self, predictions: Predictions) -> Iterator[str]:
        """Yield remarks on predictions that do not count, or do not count as right."""
        if predictions.is_out_of_view.any():
            yield _make_hidden_remark(predictions)
        if predictions.n_non_finite:
            yield (
                f"{predictions.n_non_finite} predictions of the model are not "
                "numbers; they count as not right."
            )


def _make_noise_remark(spp: int) -> str:
    """Return that noise may decide the worst margin, with the samples that were tried."""
    return (
        "It is not shown that the worst margin keeps its side beyond "
        f"{spp} samples a pixel, the most "
        "that a check takes: noise may take part in it."
    )


def _make_hidden_remark(predictions: Predictions) -> str:
    """Return a remark on images without the object, which are not counted."""
    n_hidden = int(predictions.is_out_of_view.sum())
    # With several models, an image counts once for each.
    images = format_count(int(predictions.has_prediction.sum()), "picture")
    # predictions that find an object of which nothing is in the image
    n_phantoms = predictions.n_phantoms_out_of_view
    phantoms = ""
    if n_phantoms:
        phantoms = f" In {n_phantoms} of them the model finds the object all the same."
    return (
        f"In {n_hidden} of {images} nothing of the object is to be seen: they "
        f"are not counted.{phantoms}"
    )


def _is_blind(rates: ChangeRates) -> bool:
    """Return whether most predictions stay the same if the object is hidden.

    The claim is that they change. If the 95 % interval of the fraction that does lies
    below one half, most of them do not.
    """
    # The upper bound of the fraction of predictions that meet the claim; 1 if no
    # interval is known.
    upper_bound = rates.interval[1] if rates.interval is not None else 1.0
    return rates.claim == "must_change" and upper_bound < 0.5


def _make_blind_remark(rates: ChangeRates) -> str:
    """Return that most predictions of a model stay the same without the object."""
    # `correct` counts the predictions that changed.
    n_same = rates.configurations - rates.correct
    return (
        f"{rates.model} says the same in {n_same} of "
        f"{rates.configurations} pictures when {BLIND[rates.when]}: it may "
        "not be looking at the object."
    )


def _format_megabytes(megabytes: float) -> str:
    """Return a size as text, in gigabytes if it is large; at least 0.1 MB."""
    if megabytes >= 1e3:
        return f"{megabytes / 1e3:.1f} GB"
    return f"{max(megabytes, 0.1):.1f} MB"


def _has_stored_non_finite(run: RunDirectory | None) -> bool:
    """Return whether a run has the note that some values of images were not finite."""
    return run is not None and run.store.read_note(NOT_FINITE) is not None


def _get_names(items: Iterable[Any]) -> list[str]:
    """Return the names of models or controls."""
    return [item.name for item in items]


def _pair_evaluations(batch: BatchResult) -> list[tuple[Query, Evaluation]]:
    """Return the queries of a batch with their evaluations.

    Evaluations state the machine that made them. If the worker of the batch died, they
    state that the evaluation is lost.
    """
    queries = [query for _, _, query in batch.items]  # an item ends with its query
    evaluations = batch.value
    if batch.failure_reason:  # the reason, as a text
        evaluations = [
            make_lost_evaluation(query, batch.failure_reason) for query in queries
        ]
    return [
        (query, replace(evaluation, machine=batch.machine))
        for query, evaluation in zip(queries, evaluations, strict=True)
    ]


def _make_axis_rows(
    axes: Iterable[TableAxis],
    right: npt.NDArray[np.bool_],
    units: npt.NDArray[np.int64],
    outcome: npt.NDArray[np.uint8],
) -> list[AxisRow]:
    """Return the rows of the tables of all axes.

    Args:
        axes: axes of the tables.
        right: (n,) whether each prediction is right.
        units: (n,) the independent unit of each prediction.
        outcome: (n,) index of each outcome in `result.OUTCOMES`.
    """
    return [row for axis in axes for row in axis.make_rows(right, units, outcome)]


def _make_claim(judgement: Judgement) -> WorstClaim:
    """Return what a result states about the prediction in one image."""
    return WorstClaim(
        **vars(judgement.prediction),
        margin=judgement.margin,
        payload=judgement.payload,
    )


def _describe_values(query: Query) -> dict[str, DescribedValue]:
    """Return the values of a query by parameter, as a result states them."""
    return {
        name: DescribedValue.from_values(value) for name, value in query.values.items()
    }
