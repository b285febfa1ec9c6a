"""The loop of a sweep: render, classify, store, count; batch after batch, in a fixed order.

The order is: scenes (object, environment), then the grid with its last axis fastest, then the draws of a point of the
grid, then the models. Models are shown the same pictures, so that they can be compared, and one is rendered once.
A batch is stored in one transaction before the next is begun, and begins at a multiple of its size, so that a sweep
that was stopped goes on bit for bit as one that was not.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from advsearch.attacks.draws import Seeds
from advsearch.attacks.product import batches
from advsearch.described import Value
from advsearch.engine.pictures import save_marked
from advsearch.engine.record import Stages
from advsearch.engine.rows import judgement_of, trial_row
from advsearch.engine.sweeps.job import Job, check_all
from advsearch.engine.sweeps.light import Shown, together
from advsearch.engine.sweeps.points import Picks, Points
from advsearch.engine.sweeps.summary import FINISHED, INTERRUPTED, Tally, rate
from advsearch.engine.sweeps.swept_scene import SweptScene
from advsearch.engine.sweeps.worst import check_worst
from advsearch.interrupts import interruptible
from advsearch.progress import Progress
from advsearch.report.drawing import new_axes
from advsearch.report.notebook import sweep_html
from advsearch.report.studies import sweep_axes, sweep_figure
from advsearch.report.wording import count
from advsearch.runs import store
from advsearch.runs.directory import RunDirectory
from advsearch.runs.export import to_pandas
from advsearch.runs.files import write_bytes
from advsearch.runs.images import write_layers
from advsearch.runs.results.attack import DescribedValue, LinearTransport
from advsearch.runs.results.base import Formation
from advsearch.runs.results.sweep import SweepSummary, WorstClaim, WorstConfiguration, WorstVerified
from advsearch.scene.description import OBJECT
from advsearch.scene.transport.renderer import SPP as BASIS_SPP
from advsearch.tasks import Judgement
from advsearch.viewer import thumbnails
from advsearch.viewer.sweep_page import write_page

KIND = "sweep"
"""Rows of the sweep; those of the trials are called "verification"."""

NOT_FINITE = "pictures not finite"
"""The note under which the store keeps that there were some."""

PICTURE_SPP = 64
"""Samples a pixel of the picture that is kept, unless verification needed more."""

AOV_FOLDER = "aov"
"""Folder of a run with the ground truth of each picture, by its number."""

TELL_SECONDS = 0.1
"""Least time between two reports of progress."""

READ_AT_ONCE = 256
"""Pictures whose places are worked out at once when rows are read back."""


@dataclass(frozen=True, eq=False, repr=False)
class SweepResult:
    """The answer of a sweep.

    Attributes:
        summary: what `summary.json` holds.
        run: the run directory, or None if it was not kept.
        in_memory: the rows, where there is no run directory.
    """

    summary: SweepSummary
    run: Path | None
    in_memory: tuple[store.Row, ...] = ()

    @property
    def accuracy(self) -> float | None:
        """Share of the configurations that the model got right; None where there was none."""
        return self.summary.accuracy

    def rows(self) -> Iterator[store.Row]:
        """Yield every configuration with its values and what the model said, in order."""
        if self.run is None:
            yield from self.in_memory
            return
        with store.Store(self.run / store.NAME, read_only=True) as results:
            yield from results.rows(KIND)

    def to_pandas(self) -> Any:
        """Return every configuration as a row of a `pandas.DataFrame`; columns as in an export (docs/runs.md).

        Raises:
            InputError: pandas is not installed.
        """
        return to_pandas(self.rows())

    def plot(self, axes: Any = None) -> Any:
        """Draw the map over two axes, or the accuracy along the only one, and return the matplotlib axes.

        Args:
            axes: to draw on; None makes new ones.
        """
        axes = new_axes() if axes is None else axes
        sweep_axes(self.summary, axes)
        return axes

    def __repr__(self) -> str:
        right = f"{self.summary.correct} of {self.summary.configurations} right"
        return f"SweepResult({self.summary.object!r}, {self.summary.model!r}, {right}, run={self._place})"

    def _repr_html_(self) -> str:
        return sweep_html(self.summary)

    @property
    def _place(self) -> str:
        return "None" if self.run is None else repr(str(self.run))


class Sweep:
    """One sweep, from its first configuration or from where it was stopped.

    Args:
        job: what is swept.
        run: open directory to keep it in, with the rows that are there already; None keeps it in memory.
        progress: told how far it is.
    """

    def __init__(self, job: Job, run: RunDirectory | None, progress: Progress) -> None:
        self.job, self.run, self.stages = job, run, Stages(progress)
        self.stages.begin("setup", "preparing the scenes for rendering")
        self.points, self._shown = check_all(job)
        self.per_scene, self.models = self.points.count, len(job.models)
        self.total = len(job.places) * self.per_scene * self.models
        self.samples = job.spp
        self._seeds = Seeds(job.pictures.seed, KIND)
        self._kept: list[store.Row] = []
        self._view: SweptScene | None = None
        self._rendered = self._traced = self._predicted = 0
        self._transport: list[LinearTransport | None] = []
        self._not_finite = run is not None and run.store.note(NOT_FINITE) is not None
        self._told, self._untold = 0.0, 0
        objects, environments = (
            list(dict.fromkeys(getattr(place, name) for place in job.places)) for name in ("object", "environment")
        )
        self._outer = [("object", objects), ("environment", environments), ("model", [one.name for one in job.models])]
        self._places = [(objects.index(one.object), environments.index(one.environment)) for one in job.places]

    def carry_out(self, first: int | None = None) -> SweepResult:
        """Do what is left and return the answer.

        Args:
            first: number of the configuration to begin with; None goes on behind the rows that are stored.
        """
        tally = self._counted()
        first = tally.seen if first is None else first
        ending, worst = FINISHED, None
        for text in self.job.warnings:
            self.stages.progress.message(text)
        try:
            with interruptible():
                self._open(min(first, self.total - 1) // self.models // self.per_scene)
                hint = f"{self.total} answers, pictures of {count(self.samples, 'sample')} a pixel; `resolution`, `spp`"
                hint += " or fewer points shorten it"
                if self.run is not None and self.job.keep_pictures != "none":
                    hint += f"; pictures that are kept take {self._pictures_text()}"
                self.stages.begin("sweep", "rendering and classifying", self.total, hint=hint)
                self.stages.progress.advance(first)
                self._go_through(first, tally)
                worst = self._claimed(tally)
                if worst is not None:
                    worst = worst.model_copy(update={"verified": self._verified(worst)})
        except KeyboardInterrupt:
            ending = INTERRUPTED
            if self.run is not None and self.run.store.count(KIND) != tally.seen:
                tally = self._counted()
            worst = self._claimed(tally)
        self.stages.end()
        return self._finish(tally, ending, worst)

    # ---- the loop ---------------------------------------------------------------------------------------------------

    def _go_through(self, first: int, tally: Tally) -> None:
        begin_scene, begin = divmod(first // self.models, self.per_scene)
        for scene in range(begin_scene, len(self.job.places)):
            view = self._open(scene)
            try:
                for numbers in batches(begin, self.per_scene, self.job.batch):
                    self._batch(view, numbers, tally)
            finally:
                self._transport += [one.summary() for one in view.light.values()]
            begin = 0

    def _batch(self, view: SweptScene, numbers: range, tally: Tally) -> None:
        """Render, classify and store neighbouring pictures of a scene, then count them."""
        begun = time.perf_counter()
        before = view.number * self.per_scene
        picks = self.points.picks(numbers.start, len(numbers), before)
        noise = [self._seeds(before + number) for number in numbers]
        seen = view.look(picks, noise)
        seconds = (time.perf_counter() - begun) / (len(numbers) * self.models)
        rows = [
            self._shown_row(
                self._row(before + number, model, noise[k], seen.judgements[model][k], seen.values[model][k], seconds),
                model,
                seen.shown[model][k],
            )
            for k, number in enumerate(numbers)
            for model in range(self.models)
        ]
        if self.run is None:
            self._kept += rows
        else:
            for k, number in enumerate(numbers):
                if self._is_kept(seen.judgements[model][k] for model in range(self.models)):
                    thumbnails.keep(self.run.path, before + number, seen.pictures[k])
            if self.job.aovs:
                for number, surfaces in zip(numbers, view.surfaces(picks), strict=True):
                    file = self.run.path / AOV_FOLDER / f"{before + number:06d}.exr"
                    write_layers(file, surfaces.layers(self.job.aovs, OBJECT), surfaces.notes(self.job.aovs))
            self.run.record(*rows)
        self._spend(rows)
        for k in range(len(numbers)):
            for model in range(self.models):
                self._count(tally, view.number, picks, k, model, seen.judgements[model][k])
        self._rendered += len(numbers) * len(view.renderers)
        if view.not_finite and not self._not_finite:
            self._not_finite = True
            if self.run is not None:
                self.run.store.set_note(NOT_FINITE, "yes")
        self._tell(len(rows), tally)

    def _pictures_text(self) -> str:
        """What the kept pictures take, said beforehand."""
        height, width = self.job.sizes[0]
        share = min(1.0, thumbnails.SIDE / max(height, width)) ** 2 * height * width / thumbnails.SIDE**2
        megabytes = self.total // self.models * thumbnails.BYTES * share / 1e6
        size = f"{megabytes / 1e3:.1f} GB" if megabytes >= 1e3 else f"{max(megabytes, 0.1):.1f} MB"
        return f"about {size}" if self.job.keep_pictures == "all" else f"at most about {size}"

    def _is_kept(self, seen: Iterable[Judgement]) -> bool:
        """Whether the thumbnail of a picture of which the models say this is kept."""
        asked = self.job.keep_pictures
        return asked == "all" or (asked == "wrong" and not all(one.right for one in seen))

    def _row(
        self, number: int, model: int, seed: int, trial: Judgement, values: dict[str, Value], seconds: float
    ) -> store.Row:
        place = self.job.places[number // self.per_scene]
        lit_by = self.points.lit_by(values)
        named = place.values
        if lit_by is not None:
            named["environment"] = {"value": lit_by, "unit": ""}
        named |= {"model": {"value": self.job.models[model].name, "unit": ""}, **values}
        row = trial_row(KIND, number * self.models + model, seed, self.samples, trial, named, sought=False)
        return replace(row, seconds=seconds)

    def _shown_row(self, row: store.Row, model: int, shown: Shown) -> store.Row:
        """The row with how its picture was made: a predicted one has no seed of its own."""
        row = replace(row, renders=shown.traced if self._is_first_of_size(model) else 0)
        return replace(row, seed=None, spp=BASIS_SPP) if shown.predicted else row

    def _is_first_of_size(self, model: int) -> bool:
        """Whether no model before it is shown the same pictures."""
        return self.job.sizes[model] not in self.job.sizes[:model]

    def _tell(self, count: int, tally: Tally) -> None:
        self._untold += count
        now = time.monotonic()
        if now - self._told >= TELL_SECONDS:
            self.stages.progress.advance(self._untold, accuracy=tally.correct / tally.seen)
            self._told, self._untold = now, 0

    def _open(self, scene: int) -> SweptScene:
        """The scene with this number; loading it lets the one before go."""
        if self._view is None or self._view.number != scene:
            self._view = None
            self._view = SweptScene(self.job, scene)
        return self._view

    # ---- counting ---------------------------------------------------------------------------------------------------

    def _counted(self) -> Tally:
        """Counts of the rows that are stored already, read one after the other."""
        tally = Tally(self._outer, self.job.axes, self._shown)
        self._traced = self._predicted = 0
        if self.run is None:
            self._spend(self._kept)
            return tally
        key, picks = (-1, -1), self.points.picks(0, 0)
        for row in self.run.store.rows(KIND):
            number, model = divmod(row.step, self.models)
            scene, local = divmod(number, self.per_scene)
            block, place = divmod(local, READ_AT_ONCE)
            if key != (scene, block):
                key, begin = (scene, block), block * READ_AT_ONCE
                size = min(READ_AT_ONCE, self.per_scene - begin)
                picks = self.points.picks(begin, size, scene * self.per_scene)
            self._count(tally, scene, picks, place, model, judgement_of(row))
            self._spend([row])
        return tally

    def _spend(self, rows: Sequence[store.Row]) -> None:
        """Count the pictures that rows took; old ones don't say it."""
        for row in rows:
            first = self._is_first_of_size(row.step % self.models)
            self._traced += int(first) if row.renders is None else row.renders
            self._predicted += row.seed is None and first

    def _count(self, tally: Tally, scene: int, picks: Picks, k: int, model: int, trial: Judgement) -> None:
        tally.add((picks.number + k) * self.models + model, (*self._places[scene], model), picks, k, trial)

    # ---- the worst configuration ------------------------------------------------------------------------------------

    def _claimed(self, tally: Tally) -> WorstConfiguration | None:
        """What the sweep saw at its worst."""
        if tally.worst is None:
            return None
        index, seen = tally.worst
        points, picks, model = self._find(index)
        u = points.configurations(picks)
        values = points.values(u, picks)[0]
        row = self._row(picks.number, model, self._seeds(picks.number), seen, values, 0.0)
        task, scene = self.job.tasks[model], picks.number // self.per_scene
        if task.varies:
            truth = self._open(scene).truth(model, u[0], values)
        else:
            truth = self.job.truth(self.job.places[scene], model, values)
        return WorstConfiguration(
            configuration=index,
            values={name: DescribedValue.of(value) for name, value in row.values.items()},
            seed=self._seeds(picks.number),
            label_set=list(task.truth_names(truth)),
            claimed=WorstClaim(**vars(seen.answer), margin=seen.margin, payload=seen.payload),
            verified=None,
        )

    def _verified(self, worst: WorstConfiguration) -> WorstVerified | None:
        """What fresh renders say of it; keeps a picture."""
        points, picks, model = self._find(worst.configuration)
        view = self._open(picks.number // self.per_scene)
        u = points.configurations(picks)[0]
        checked = check_worst(view, self.job, model, u, self.run, self.stages)
        if self.run is not None:
            spp = max(PICTURE_SPP, checked.spp if checked else 0)
            picture = view.picture(model, u, worst.seed, spp)
            self.run.save_image("worst", picture)
            save_marked(self.run, "worst", picture, view.marks(model, u, picture))
        return checked

    def _find(self, index: int) -> tuple[Points, Picks, int]:
        """A configuration by its number: its scene's points, its picture, its model."""
        number, model = divmod(index, self.models)
        scene, local = divmod(number, self.per_scene)
        points = self.job.points(self.job.space(self.job.places[scene], self.job.sizes[model]))
        return points, points.picks(local, 1, scene * self.per_scene), model

    # ---- the answer -------------------------------------------------------------------------------------------------

    def _finish(self, tally: Tally, ending: str, worst: WorstConfiguration | None) -> SweepResult:
        """Put the summary together and write it."""
        job, seconds = self.job, self.stages.seconds
        view, checked = self._view, worst.verified if worst else None
        swept = seconds.get("sweep", 0.0)
        summary = SweepSummary(
            run=None if self.run is None else str(self.run.path),
            object=job.object,
            model=",".join(model.name for model in job.models),
            task=job.task,
            environment=self.points.environment or job.environment,
            controls=[control.name for control in job.controls],
            ending=ending,
            image_formation=Formation.of(next(iter(view.renderers.values())).formation) if view else None,
            planned=self.total,
            **vars(rate(tally.correct, tally.seen)),
            not_finite=tally.not_finite,
            answers=tally.frequent(),
            axes=tally.table(),
            cells=tally.map(),
            worst=worst,
            grid={axis.name: len(axis.values) for axis in job.axes},
            samples=job.samples,
            sampler=job.sampler if job.controls else None,
            spp=self.samples,
            renders={
                "sweep": self._traced,
                "verification": checked.renders if checked else 0,
                **({"products": self._predicted} if self._predicted else {}),
            },
            transport=together(self._transport),
            renders_per_second=self._rendered / swept if self._rendered and swept else None,
            seconds={**seconds, "total": self.stages.total},
            seed=job.pictures.seed,
            warnings=[*job.warnings, *self._remarks(tally, checked)],
            command_line=job.command_line,
        )
        if self.run is not None:
            self.run.write_summary(summary)
            for suffix, data in sweep_figure(summary).items():
                write_bytes(self.run.path / "images" / f"sweep.{suffix}", data)
            write_page(self.run.path, summary)
        return SweepResult(summary, None if self.run is None else self.run.path, tuple(self._kept))

    def _remarks(self, tally: Tally, checked: WorstVerified | None) -> list[str]:
        """What a reader has to know beside the numbers."""
        remarks = []
        if tally.not_finite:
            remarks.append(f"{tally.not_finite} answers of the model were not finite; they count as not right.")
        if self._not_finite:
            remarks.append("Some values of pictures were not finite and were set to 0.")
        if checked and not checked.converged:
            remarks.append(
                f"The worst margin still moved with the sample count at {checked.spp} samples a pixel, the most "
                "that was tried: noise may take part in it."
            )
        return remarks


def carry_out(job: Job, run: RunDirectory | None, progress: Progress, first: int | None = None) -> SweepResult:
    """Sweep, check the worst configuration and write the summary; see `Sweep`."""
    return Sweep(job, run, progress).carry_out(first)
