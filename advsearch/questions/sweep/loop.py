"""The loop of a sweep: ask about every configuration, store and count what is
predicted, sum it up. They are numbered: scenes (beside an adversarial scene first all
without it), then the grid with its last axis fastest, then draws, then models; a batch
begins at a multiple of its size, so that a sweep that was stopped, or whose batches
come in another order, ends bit for bit as any other.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace

import numpy as np
import numpy.typing as npt

from advsearch.attacks.domain import batches
from advsearch.cluster import InProcess, Workers
from advsearch.engine.journal import Journal, Sent, Shared, lost, worker_call
from advsearch.engine.loading import framed
from advsearch.engine.record import LOST, judgement_of, lost_remarks
from advsearch.interrupts import interruptible
from advsearch.options import OUT_OF_VIEW
from advsearch.progress import Progress, Stages
from advsearch.questions.attack.result import save_marked
from advsearch.questions.sweep import summary as results
from advsearch.questions.sweep.display import sweep_figure
from advsearch.questions.sweep.drives import Drives, time_axis
from advsearch.questions.sweep.job import KIND, Job, OpenScenes, check_all, check_worst
from advsearch.questions.sweep.page import write_sweep_page
from advsearch.questions.sweep.predicting import combined
from advsearch.questions.sweep.result import (
    FINISHED,
    Predictions,
    SweepResult,
    SweptAxis,
    counted_by_unit,
    map_over,
)
from advsearch.questions.sweep.settings import BLIND
from advsearch.questions.sweep.summary import WorstConfiguration, WorstVerified
from advsearch.questions.sweep.surface import map_surface
from advsearch.report.wording import count, repeats_remark
from advsearch.runs.directory import AOV_FOLDER, RunDirectory
from advsearch.runs.files import write_layers
from advsearch.runs.results import (
    INTERRUPTED,
    DescribedValue,
    Formation,
    LinearTransport,
    SharedWork,
)
from advsearch.runs.store import Row
from advsearch.runs.tables import EDGES, NOTE
from advsearch.statistics.clustered import most_shown
from advsearch.tasks import Judgement
from advsearch.trust.writing import write_bytes
from advsearch.viewer import thumbnails

# the note under which the store keeps that there were some
NOT_FINITE = "pictures not finite"
# samples a pixel of the picture that is kept, unless verification needed more
PICTURE_SPP = 64
ENOUGH_DRIVES = 20  # of fewer, a sweep says what they could show at best
TELL_SECONDS = 0.1
MOST_METERED = 256  # scenes whose gains a summary lists; of more it has none
DRAWN_AT_ONCE = 4096  # pictures whose draws are worked out at once for the tables


class Sweep:
    """One sweep, from its first configuration or from where it was stopped: `run` has
    the rows that are there already, and None keeps it in memory. Without an executor
    all is done here.
    """

    def __init__(
        self,
        job: Job,
        run: RunDirectory | None,
        progress: Progress,
        executor: Workers | None = None,
    ) -> None:
        self.job, self.run, self.stages = job, run, Stages(progress)
        self.stages.begin("setup", "preparing the scenes for rendering")
        self.points, self._shown = check_all(job)
        self.per_scene = self.points.count
        self.models = len(job.models)
        self.units = replace(self.points.units, models=self.models)
        if run is not None:
            run.store.set_note(
                EDGES,
                json.dumps(
                    {drawn.name: drawn.edges for drawn in self._shown if drawn.edges}
                ),
            )
            run.store.set_note(NOTE, json.dumps(asdict(self.units)))
        self.total = len(job.places) * self.per_scene * self.models
        self._scenes = OpenScenes(job)
        self._executor = (
            InProcess(worker_call(self._scenes.named)) if executor is None else executor
        )
        self.journal = Journal(run, Shared(None, executor))
        self._rendered = self._traced = self._predicted = self._lost = 0
        self._transport: dict[tuple[str, int], list[LinearTransport | None]] = {}
        self._not_finite = run is not None and run.store.note(NOT_FINITE) is not None
        self._told = 0.0
        self._untold = 0
        self._begun = 0.0
        self._surface: results.SurfaceMap | None = None
        self._drives: list[results.DriveRates] | None = None

    def carry_out(self, first: int | None = None) -> SweepResult:
        """Do what is left, or all from the configuration with a number on, and return
        the result.
        """
        predictions = self._counted()
        ending = FINISHED
        for text in self.job.warnings:
            self.stages.progress.message(text)
        try:
            with interruptible():
                left = [range(first, self.total)] if first is not None else self._left()
                self._scenes.open(
                    self._scene_of(left[0].start if left else self.total - 1)
                )
                self._go_through(left, predictions)
                worst = self._worst(predictions, verify=True)
                if self.job.config.surface and self.run is not None:
                    self.stages.begin(
                        "surface", "tracing the surface that was seen", self.total
                    )
                    self._surface = map_surface(
                        self._scenes, self.rows(), self.run, self.stages.progress
                    )
                if time_axis(self.job.axes) is not None:
                    self.stages.begin(
                        "drives", "rendering the frames of the worst drive"
                    )
                    drives = Drives(self.job, self.rows())
                    if self.run is not None:
                        drives.keep_worst(self._scenes, self.run)
                    self._drives = drives.rates()
        except KeyboardInterrupt:
            ending = INTERRUPTED
            predictions = self._counted()
            worst = self._worst(predictions)
        self.stages.end()
        return self._finish(predictions, ending, worst)

    def _scene_of(self, configuration: int) -> int:
        return configuration // self.models // self.per_scene

    def _left(self) -> list[range]:
        return (
            [range(self.total)]
            if self.run is None
            else list(self.run.store.missing(KIND, self.total))
        )

    def _go_through(self, left: Sequence[range], predictions: Predictions) -> None:
        hint = (
            f"{self.total} predictions, pictures of "
            f"{count(self.job.spp, 'sample')} "
            "a pixel; `resolution`, `spp` or "
        )
        hint += "fewer points shorten it"
        keep = self.job.config.keep_pictures
        if self.run is not None and keep != "none":
            height, width = self.job.sizes[0]
            share = (
                min(1.0, thumbnails.SIDE / max(height, width)) ** 2
                * height
                * width
                / thumbnails.SIDE**2
            )
            megabytes = self.total // self.models * thumbnails.BYTES * share / 1e6
            size = (
                f"{megabytes / 1e3:.1f} GB"
                if megabytes >= 1e3
                else f"{max(megabytes, 0.1):.1f} MB"
            )
            hint += (
                "; pictures that are kept take "
                f"{'about' if keep == 'all' else 'at most about'} {size}"
            )
        self.stages.begin("sweep", "rendering and classifying", self.total, hint=hint)
        self.stages.progress.advance(self.total - sum(map(len, left)))
        self._begun = time.monotonic()
        for done in self._executor.results(self._asked(left)):
            queries = [query for *_, query in done.items]
            evaluations = (
                [lost(query, done.lost) for query in queries]
                if done.lost
                else done.value
            )
            evaluations = [
                replace(evaluation, machine=done.machine) for evaluation in evaluations
            ]
            evaluated = list(zip(queries, evaluations, strict=True))
            if self.run is not None:
                for query, evaluation in evaluated:
                    number = query.number // self.models
                    if evaluation.small is not None:
                        thumbnails.keep(self.run.path, number, evaluation.small)
                    if evaluation.layers is not None:
                        write_layers(
                            self.run.path / AOV_FOLDER / f"{number:06d}.exr",
                            *evaluation.layers,
                        )
            self._spend(self.journal.keep(evaluated, numbered=True))
            self._rendered += sum(
                self.job.first_of_size[query.number % self.models] for query in queries
            )
            self._transport[done.worker, self._scene_of(queries[0].number)] = (
                evaluations[-1].light or []
            )
            if (
                any(evaluation.non_finite for evaluation in evaluations)
                and not self._not_finite
            ):
                self._not_finite = True
                if self.run is not None:
                    self.run.store.set_note(NOT_FINITE, "yes")
            for query, evaluation in evaluated:
                predictions.add(query.number, evaluation.said)
            self._tell(len(queries), predictions)
        self.journal.rows.sort(key=lambda row: row.step)

    def _asked(self, left: Sequence[range]) -> Iterator[list[Sent]]:
        for part in left:
            first = part.start // self.models
            last = -(-part.stop // self.models)
            while first < last:
                before = first // self.per_scene * self.per_scene
                for piece in batches(
                    first - before,
                    min(last - before, self.per_scene),
                    self.job.config.batch,
                ):
                    asked = self.job.queries(
                        range(before + piece.start, before + piece.stop)
                    )
                    yield [
                        one for one in asked if part.start <= one[2].number < part.stop
                    ]
                first = before + self.per_scene

    def _tell(self, count: int, predictions: Predictions) -> None:
        self._untold += count
        now = time.monotonic()
        if now - self._told >= TELL_SECONDS:
            beside = dict[str, float | str]()
            if seen := int(predictions.counted.sum()):
                beside["accuracy"] = (
                    int((predictions.right & predictions.counted).sum()) / seen
                )
            if (facts := self._executor.facts) is not None:
                beside |= {
                    **facts.told,
                    "a second": self._rendered / max(1e-9, now - self._begun),
                }
            self.stages.progress.advance(self._untold, **beside)
            self._told = now
            self._untold = 0

    def _counted(self) -> Predictions:
        predictions = Predictions(self.total)
        self._traced = self._predicted = self._lost = 0
        for row in self.rows():
            predictions.add(row.step, judgement_of(row))
            self._spend([row])
        return predictions

    def rows(self) -> Iterable[Row]:
        return self.journal.rows if self.run is None else self.run.store.rows(KIND)

    def _spend(self, rows: Sequence[Row]) -> None:
        """Count the pictures that rows took; old ones don't say it."""
        for row in rows:
            first = self.job.first_of_size[row.step % self.models]
            self._traced += int(first) if row.renders is None else row.renders
            self._predicted += row.seed is None and first
            self._lost += row.label == LOST

    def _axes(self, numbers: npt.NDArray[np.int64]) -> list[SweptAxis]:
        """What the tables are by, with the places of configurations by their numbers
        (n,).
        """
        job = self.job
        (pictures, model) = np.divmod(numbers, self.models)
        scene, local = np.divmod(pictures, self.per_scene)
        axes = []
        for what in ("object", "environment", "answer"):
            names = [place.names.get(what, "") for place in job.places]
            several = list(dict.fromkeys(names))
            axes.append(
                SweptAxis(
                    what,
                    "",
                    several,
                    np.array([several.index(name) for name in names])[scene],
                )
            )
        axes.append(SweptAxis("model", "", [one.name for one in job.models], model))
        digits = (
            np.unravel_index(local // job.samples, self.points.grid.sizes)
            if job.axes
            else ()
        )
        of_the_grid = zip(job.axes, digits, strict=True)
        axes += [
            SweptAxis(one.name, one.unit, one.values, at, "grid")
            for one, at in of_the_grid
        ]
        if self._shown and len(numbers):
            scenes = range(0, int(pictures[-1]) + 1, self.per_scene)
            blocks = [
                block
                for first in scenes
                for block in batches(first, first + self.per_scene, DRAWN_AT_ONCE)
            ]
            drawn = [
                self.points.parts_of(one.start, len(one))
                for one in blocks
                if one.start <= pictures[-1]
            ]
            parts = zip(self._shown, np.concatenate(drawn)[pictures].T, strict=True)
            axes += [
                SweptAxis(one.name, one.unit, one.parts, at, "drawn")
                for one, at in parts
            ]
        return [one for one in axes if len(one.values) > 1]

    def _worst(
        self, predictions: Predictions, verify: bool = False
    ) -> WorstConfiguration | None:
        """What the sweep saw at its worst; if asked, with what fresh renders say of it,
        and what the model says of the picture that is kept.
        """
        index = predictions.worst
        if index is None:
            return None
        rows = (
            self.journal.rows if self.run is None else [self.run.store.row(KIND, index)]
        )
        row = next(row for row in rows if row is not None and row.step == index)
        number, model = divmod(index, self.models)
        query = self.job.queries(range(number, number + 1))[model][2]
        task = self.job.tasks[model]
        scene = self._scene_of(index)
        if task.varies:
            truth = (
                self._scenes.open(scene).problems[model].truth(query.u, query.values)
            )
        else:
            truth = task.truth(self.job.facts(self.job.places[scene], query.values))
        worst = WorstConfiguration(
            configuration=index,
            values={
                name: DescribedValue.of(value) for name, value in query.values.items()
            },
            seed=query.seed,
            label_set=list(task.truth_names(truth)),
            claimed=_claim_of(judgement_of(row)),
            verified=None,
        )
        if not verify:
            return worst
        problem = self._scenes.open(scene).problems[model]
        checked = check_worst(problem, self.job.config, query.u, self.run, self.stages)
        if self.run is None:
            return worst.model_copy(update={"verified": checked})
        picture = problem.picture(
            query.u, worst.seed, max(PICTURE_SPP, checked.spp if checked else 0)
        )
        self.run.save_image("worst", picture)
        save_marked(self.run, "worst", picture, problem.marks(picture, query.u))
        pictured = _claim_of(problem.judge(picture, query.u))
        return worst.model_copy(update={"verified": checked, "pictured": pictured})

    def _finish(
        self, predictions: Predictions, ending: str, worst: WorstConfiguration | None
    ) -> SweepResult:
        job = self.job
        run = self.run
        seconds = self.stages.seconds
        view = self._scenes.scene
        checked = worst.verified if worst else None
        predicting = self._transport.values() or [
            [one.summary() for one in (view.predicted.values() if view else ())]
        ]
        swept = seconds.get("sweep", 0.0)
        formation = (
            Formation.of(next(iter(view.renderers.values())).formation)
            if view
            else None
        )
        gains: dict[str, float] = {}
        if formation and len(job.places) <= MOST_METERED:
            for place in job.places:
                gains[f"{place.object}, {place.environment}"] = framed(
                    place.scene.description, job.sizes[0]
                ).gain
        if formation and len(set(gains.values())) != 1:
            formation = formation.model_copy(update={"gain": None})
        models = [model.name for model in job.models]
        adversarial = job.places[-1].beside_clean
        numbers = np.flatnonzero(predictions.counted)
        right = predictions.right[numbers]
        units = self.units.of(numbers)
        axes = self._axes(numbers)
        outcome = predictions.outcome[numbers]
        changes = self._changes()
        renders = {
            "sweep": self._traced,
            "verification": checked.renders if checked else 0,
        }
        pairs = predictions.beside(models, self.units) if adversarial else []
        summary = results.SweepSummary(
            run=None if run is None else str(run.path),
            object=job.config.object,
            model=",".join(models),
            task=job.config.task_name,
            environment=self.points.environment or job.config.lit_by,
            controls=[control.name for control in job.controls],
            ending=ending,
            image_formation=formation,
            gains=gains if len(gains) > 1 else None,
            drawn={one.name: one.varied for one in self._shown},
            planned=self.total,
            **vars(counted_by_unit(right, units, outcome)),
            out_of_view=int(predictions.hidden.sum()),
            phantoms_out_of_view=predictions.phantoms_out_of_view,
            units=len(np.unique(units)) if self.units.size > 1 and len(units) else None,
            not_finite=predictions.not_finite,
            answers=predictions.frequent,
            axes=[row for axis in axes for row in axis.rows(right, units, outcome)],
            cells=map_over(axes, right, predictions.margin[numbers]),
            beside=results.BesideClean(answer=adversarial, pairs=pairs)
            if adversarial
            else None,
            worst=worst,
            grid={axis.name: len(axis.values) for axis in job.axes},
            samples=job.samples,
            sampler=job.config.sampler if self.points.draws else None,
            spp=job.spp,
            renders={**renders, "products": self._predicted}
            if self._predicted
            else renders,
            transport=combined([one for light in predicting for one in light]),
            surface=self._surface,
            drives=self._drives,
            changes=changes or None,
            shared=SharedWork.of_facts(self._executor.facts, self.journal.machines),
            renders_per_second=self._rendered / swept
            if self._rendered and swept
            else None,
            seconds={**seconds, "total": self.stages.total},
            seed=job.config.seed,
            warnings=[*job.warnings, *self._remarks(predictions, checked, changes)],
            command_line=job.config.command_line(None if run is None else run.path),
            python_only=job.config.python_only,
        )
        if run is not None:
            for suffix, data in sweep_figure(summary).items():
                write_bytes(run.path / "images" / f"sweep.{suffix}", data)
            write_sweep_page(run.path, summary)
            run.write_summary(summary)  # last: without a page the run is not done
        return SweepResult(
            summary, None if run is None else run.path, tuple(self.journal.rows)
        )

    def _changes(self) -> list[results.ChangeRates]:
        rates: list[results.ChangeRates] = []
        for claim, when in self.job.config.claims:
            name = f"{claim} {when}"
            shown = (row for row in self.rows() if row.label != OUT_OF_VIEW)
            held = {row.step: row.metrics[name] for row in shown if name in row.metrics}
            for model, network in enumerate(self.job.models):
                numbers = np.array(
                    [one for one in held if one % self.models == model], dtype=np.int64
                )
                right = np.array(
                    [held[one] == 1.0 for one in numbers.tolist()], dtype=bool
                )
                counts = vars(counted_by_unit(right, self.units.of(numbers)))
                row = (
                    int(numbers[~right][0])
                    if len(numbers) and not right.all()
                    else None
                )
                rates.append(
                    results.ChangeRates(
                        **counts, model=network.name, claim=claim, when=when, row=row
                    )
                )
        return rates

    def _remarks(
        self,
        predictions: Predictions,
        checked: WorstVerified | None,
        changes: Sequence[results.ChangeRates],
    ) -> Iterator[str]:
        yield from (*lost_remarks(self._lost), *self.journal.remarks)
        if self.units.noise > 1:
            yield repeats_remark(
                self.units.name, self.units.noise, self.total // self.units.size
            )
        few = min((rates.drives for rates in self._drives or ()), default=ENOUGH_DRIVES)
        if few == 1 and self.units.noise == 1:
            yield "One drive says nothing of others: there is no interval over drives."
        elif 1 < few < ENOUGH_DRIVES:
            yield (
                f"{count(few, 'drive')} can show little: were the model right in all "
                "their frames, the interval of "
                f"that share would begin at {100 * most_shown(few):.0f} %."
            )
        if hidden := int(predictions.hidden.sum()):
            seen = count(int(predictions.seen.sum()), "picture")
            phantoms = predictions.phantoms_out_of_view
            more = (
                f" In {phantoms} of them the model finds the object all the same."
                if phantoms
                else ""
            )
            yield (
                f"In {hidden} of {seen} nothing of the object is to be seen: they "
                f"are not counted.{more}"
            )
        if predictions.not_finite:
            yield (
                f"{predictions.not_finite} predictions of the model are not "
                "numbers; "
                "they count as not right."
            )
        if self._not_finite:
            yield "Some values of pictures were not finite and were set to 0."
        if checked and not checked.converged:
            yield (
                "It is not shown that the worst margin keeps its side beyond "
                f"{checked.spp} samples a pixel, the most "
                "that a check takes: noise may take part in it."
            )
        for rates in changes:
            if (
                rates.claim == "must_change"
                and rates.interval is not None
                and rates.interval[1] < 0.5
            ):
                alike = (
                    f"{rates.configurations - rates.correct} of "
                    f"{rates.configurations} pictures"
                )
                text = (
                    f"{rates.model} says the same in {alike} when {BLIND[rates.when]}"
                )
                yield f"{text}: it may not be looking at the object."


def _claim_of(seen: Judgement) -> results.WorstClaim:
    return results.WorstClaim(
        **vars(seen.prediction), margin=seen.margin, payload=seen.payload
    )
