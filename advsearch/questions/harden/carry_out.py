"""`harden`: trains a copy of a model on its worst cases, and measures it on what training never saw, before and
after."""

from __future__ import annotations

import gc
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from advsearch import seeds
from advsearch.api.keywords import asks, configured
from advsearch.attacks import clopper_pearson
from advsearch.cluster import Executor, InProcess
from advsearch.engine.journal import check_made_of
from advsearch.engine.naming import AnyModel, check_not_spread, check_run_settings, load_models, model_name
from advsearch.engine.record import Stages
from advsearch.errors import ClusterError, InputError, ModelError
from advsearch.models.reference import trainable
from advsearch.models.source import split_weights
from advsearch.progress import Progress, Watched, watcher
from advsearch.question import Asked
from advsearch.questions.attack.parts import LOADING, executor_for
from advsearch.questions.harden import scenes, training
from advsearch.questions.harden.detectors import DetectorRounds, Loss, Student, check_detector, read_coco
from advsearch.questions.harden.lessons import FOLDER, Lesson
from advsearch.questions.harden.result import (
    PLAIN_SCENES,
    RENDERED_SCENES,
    HardenConfig,
    HardenedControl,
    HardenResult,
    Share,
    SplitSide,
)
from advsearch.questions.harden.scenes import FURTHER, HELD_OUT, ROBUST, TRAINING, VALIDATION, SceneWork, Wanted
from advsearch.questions.harden.training import WEIGHTS, Course, Examples, MakeOptimiser
from advsearch.rooms import made_question
from advsearch.runs.directory import ARTIFACTS, RunDirectory, is_run, run_path
from advsearch.runs.results import SharedWork
from advsearch.runs.store import Row
from advsearch.tasks import make_task

MEANS = "means"  # the note of what a training has from Python
MEASUREMENTS = ("before", "stronger_before", "after", "stronger")
"""What is measured over each control, by its name in the table."""
SHARED, MOVED = 0.25, 0.5
"""Shares of the scenes with a texture in which all views have the same, and in which rendered controls vary too."""


@asks(HardenConfig)
def harden(
    model: AnyModel = "reference",
    *,
    optimiser: MakeOptimiser | None = None,
    beside: Examples | None = None,
    loss: Loss | None = None,
    resume: bool = False,
    progress: Watched = None,
    **settings: Any,
) -> HardenResult:
    """Train a copy of a model on its worst cases, and prove what it is better at (docs/harden.md).

    All other arguments are the settings of `advsearch harden`. The run is kept, in `run` or under runs/. The model that
    is given stays as it is.

    Args:
        model: a classifier: what `load_model` takes, and no exported program.
        optimiser: makes one of the list of parameters, such as ``lambda p: torch.optim.SGD(p, 0.01)``; its learning
            rate is then the highest, in place of `rate`.
        beside: batches of further examples, such as a `DataLoader`: images (N, H, W, 3) sRGB in [0, 1], class indices
            (N,). One is taken with each step. Not of a detector, which `data` is for.
        loss: of a detector whose network returns none in training: a function of the network, its input (N, 3, H, W)
            and, for each picture, a mapping with "boxes" (K, 4), x0, y0, x1, y1 in pixels of that input, and "labels"
            (K,), indices of the model's labels. It returns a number that is smaller where the network is better.
        resume: go on with the run of that name, if there is one, where it was stopped; everything else has to be as it
            was.
    """
    if not isinstance(model, (str, Path)):
        check_not_spread(settings)
    config = configured(HardenConfig, model=model_name(model), **settings)
    path = run_path(config.run) if resume and config.run is not None else None
    resumed = path if path is not None and is_run(path) else None
    given = {"model": model, "optimiser": optimiser, "beside": beside, "loss": loss}
    result: HardenResult = made_question("harden").from_config(
        config, progress=watcher(progress), resumed=resumed, **given
    )
    return result


def hardened(
    asked: Asked[HardenConfig],
    *,
    model: AnyModel | None = None,
    optimiser: MakeOptimiser | None = None,
    beside: Examples | None = None,
    loss: Loss | None = None,
) -> HardenResult:
    """Do what a configuration describes, or go on with it; see `harden`. None takes the configuration's model."""
    config = asked.config
    asked.progress.stage(LOADING)
    check_run_settings(config)
    try:
        (loaded, *_), warnings = load_models([model or config.model], make_task(config.task), config)
    except ModelError as error:
        if config.task_name != "classification":
            raise
        said = str(error).partition(": use `task=")[0]
        raise ModelError(f"{said}; harden trains classifiers and, with `task=detection`, detectors") from error
    finds = config.task_name == "detection"
    if not finds and (config.task_name != "classification" or config.data or loss):
        raise InputError("task: harden trains for classification and detection; `data` and `loss` are of detection")
    if finds:
        check_detector(config, beside)
    work = SceneWork(config, loaded, scenes.splits_of(config, loaded))
    course: Course | DetectorRounds
    if finds:
        own = [] if config.data is None else read_coco(Path(config.data), loaded)
        course = DetectorRounds(asked.run, work, Student.of(loaded, loss), own, optimiser, asked.progress)
    else:
        course = Course(trainable(loaded, config.layers), loaded, config, optimiser, beside)
    means = {"optimiser": optimiser, "beside": beside, **({"loss": loss} if finds else {})}
    _same_means(asked.run, {name: one is not None for name, one in means.items()})
    check_made_of(asked.run, [loaded])
    run = Hardening(asked.run, course, work, asked.progress)
    with asked.until_interrupted():
        with executor_for(config, "advsearch.questions.harden.scenes:scenes_of", asked.progress) as executor:
            run.carry_out(executor or InProcess(work))
    return run.result(asked, warnings)


def _same_means(run: RunDirectory, given: dict[str, bool]) -> None:
    """Note what a training has from Python, or refuse (InputError) to go on with other means than it began with."""
    before = json.loads(run.store.note(MEANS) or "{}")
    run.store.set_note(MEANS, json.dumps({**given, **before}))
    for name, was in before.items():
        if was != given[name]:
            raise InputError(
                f"{run.path}: cannot resume: it began {'with' if was else 'without'} `{name}`, which only Python "
                "gives; resume it with advsearch.harden(..., run=..., resume=True) and the same arguments"
            )


class Hardening:
    """One run of `harden`: a course that trains a copy of the model, and scenes, with what was asked and the model as
    it was given. `wrong` says of what is measured, and of the number of a scene, whether it is not robust."""

    def __init__(self, run: RunDirectory, course: Course | DetectorRounds, work: SceneWork, progress: Progress) -> None:
        self.run, self.course, self.scenes, self.progress, self.config = run, course, work, progress, work.config
        self.rounds: DetectorRounds | training.TrainingRounds
        if isinstance(course, DetectorRounds):
            self.rounds, self.further = course, 0
        else:
            self.rounds = training.TrainingRounds(run, course, self.drawn, progress)
            self.further = RENDERED_SCENES if work.rendered else PLAIN_SCENES
        self.wrong = {(row.kind, row.step): bool(row.success) for row in run.store.rows()}
        self.clean: dict[str, Share] = {}
        self.stages = Stages(progress)
        self._executor: Executor = InProcess(work)
        searched = self.config.scenes * self.config.rounds
        held = scenes.CLEAN_SCENES * self.config.measured  # of which a part is attacked
        self.counts = {TRAINING: searched, FURTHER: self.further * searched, VALIDATION: self.rounds.judged}
        self.counts[HELD_OUT] = held

    def carry_out(self, executor: Executor) -> None:
        """Measure, train, and measure again; the executor does what there is to do with scenes."""
        self._executor, sides, stages = executor, self.scenes.splits, self.stages
        scenes.check_disjoint(sides[HELD_OUT], [sides[name] for name in (TRAINING, FURTHER, VALIDATION)])
        gc.freeze()  # as of `scenes_of`
        try:
            stages.begin("measurement", "attacking the model as it is")
            self._measure("before", "attacking the model as it is")
            self._measure("stronger_before", "attacking it with a stronger search", known="before")
            stages.begin("training", "training")
            self.rounds.carry_out()
            weights = (self.run.path / ARTIFACTS / WEIGHTS).read_bytes()
            stages.begin("measurement", "attacking the hardened model")
            self._measure("after", "attacking the hardened model", weights)
            self._measure("stronger", "attacking it with a stronger search", weights, known="after")
            wanted = [scenes.Looking(number) for number in range(self.counts[HELD_OUT])]
            self.progress.stage("looking at plain pictures of held-out scenes", len(wanted))
            seen = [lesson for _, some in self._each(wanted) for lesson in some]
            for which, model in (("before", self.scenes.model), ("after", self.course.student.model)):
                self.clean[which] = _share(round(self.rounds.right_share(model, seen) * len(seen)), len(seen))
        finally:
            stages.end()
            gc.unfreeze()

    def _each(self, wanted: Sequence[Wanted]) -> Iterator[tuple[int, Any]]:
        """Have done what is wanted of scenes; yield the place of each and what came of it, in any order."""
        places = {id(one): place for place, one in enumerate(wanted)}
        for done in self._executor.results([one] for one in wanted):
            (one,) = done.items
            if done.lost:
                raise ClusterError(f"harden, scene {one.number}: {done.lost}")
            facts = self._executor.facts
            self.progress.advance(1, **({} if facts is None else facts.told))
            yield places[id(one)], done.value[0]

    def drawn(self, title: str, split: str, places: Sequence[int], views: int) -> list[Lesson]:
        """Return lessons of scenes: for each control whose pictures a matrix says, and for all others together.

        In the training a fourth of the scenes have one texture for all views, in half of them the controls that are
        rendered vary by chance, and further scenes come on top: of what is rendered new scenes teach more than further
        views. Of what is rendered one in so many scenes is drawn as it is, too: there the given model's predictions
        count.
        """
        linear, rendered, training = self.scenes.linear, self.scenes.rendered, split == TRAINING
        wanted, draw = list[Wanted](), scenes.Drawing
        for control in linear:
            for number in places:
                shared, moved = self.chance(control, number) if training else (False, False)
                wanted.append(draw(split, number, (control,), views, 1, shared, self.scenes.beside if moved else ()))
        more = [self.further * place + one for place in places for one in range(self.further)] if training else []
        if rendered:
            harder, plain = (1, 1) if training else (views, 0)
            wanted += [draw(split, number, rendered, harder, plain) for number in places]
            wanted += [draw(FURTHER, number, rendered, 1, 0) for number in more]
        else:
            wanted += [draw(FURTHER, number, linear[:1], 0, 1) for number in more]
        self.progress.stage(title, len(wanted))
        found = dict(self._each(wanted))
        return [lesson for place in range(len(wanted)) for lesson in found[place]]

    def chance(self, control: str, number: int) -> tuple[bool, bool]:
        """Return whether all views of a scene have one texture, and whether other controls vary beside it. Not by
        turns, as the objects take turns."""
        shared, moved = np.random.default_rng(seeds.stream(self.config.seed, f"views of {control}", number)).random(2)
        return bool(shared < SHARED), bool(moved < MOVED)

    def _measure(self, which: str, title: str, weights: bytes | None = None, *, known: str | None = None) -> None:
        """Attack the model, as it was given or with other weights, on every held-out scene over each control; what is
        measured is not attacked again. With the name of what is `known` of the usual search: by the stronger one, and
        what that had found is not sought any harder."""
        wanted, times = list[scenes.Attacking](), 1 if known is None else scenes.TIMES
        for number in range(self.config.measured):
            for control in self.config.controls:
                if (f"{which} {control}", number) in self.wrong:
                    continue
                if known is not None and self.wrong[f"{known} {control}", number]:
                    self._note(which, control, number, wrong=True)
                else:
                    wanted.append(scenes.Attacking(control, number, times, weights))
        self.progress.stage(title, len(wanted), hint="`measured` and `steps` shorten it")
        for place, ending in self._each(wanted):
            self._note(which, wanted[place].control, wanted[place].number, wrong=ending != ROBUST)

    def _note(self, which: str, control: str, number: int, *, wrong: bool) -> None:
        kind, seed = f"{which} {control}", seeds.stream(self.config.seed, f"measured {control}", number)
        self.wrong[kind, number] = wrong
        self.run.record(Row(kind, number, seed=seed, spp=self.config.verify_spp, success=wrong))

    def _robust(self, which: str, controls: Sequence[str]) -> Share | None:
        """Scenes that are robust to the searches over all of some controls; None where some are not known."""
        scenes_of = range(self.config.measured)
        found = [[self.wrong.get((f"{which} {control}", number)) for control in controls] for number in scenes_of]
        if any(None in wrong for wrong in found):
            return None
        return _share(sum(not any(wrong) for wrong in found), len(found))

    def paired(self, controls: Sequence[str]) -> dict[str, Any]:
        """How many scenes are robust after and were not before, the other way round, and how likely that is by
        chance; nothing where not all are known."""
        scenes_of = range(self.config.measured)
        sides = {
            which: [[self.wrong.get((f"{which} {control}", number)) for control in controls] for number in scenes_of]
            for which in ("before", "after")
        }
        if any(None in wrong for side in sides.values() for wrong in side):
            return {}
        pairs = list(zip(*([any(wrong) for wrong in side] for side in sides.values()), strict=True))
        gained, lost = pairs.count((True, False)), pairs.count((False, True))
        p = float(binomtest(gained, gained + lost).pvalue) if gained + lost else 1.0
        return {"gained": gained, "lost": lost, "p": p}

    def result(self, asked: Asked[HardenConfig], warnings: list[str]) -> HardenResult:
        """Return what is known."""
        config, done, names = self.config, asked.ending == "done", list(self.config.controls)
        table = []
        for control in names:
            shares = {which: self._robust(which, [control]) for which in MEASUREMENTS}
            if None not in shares.values():
                table.append(HardenedControl.of({"control": control, **shares}))
        if done and self.rounds.best == 0:
            warnings = [*warnings, "No round kept the clean accuracy, so the weights are the model's own."]
        weights, taught = self.run.path / ARTIFACTS / WEIGHTS, self.scenes.splits[TRAINING]
        views = {
            TRAINING: config.views,
            FURTHER: 1,
            VALIDATION: training.VALIDATION_VIEWS,
            HELD_OUT: scenes.CLEAN_VIEWS,
        }
        split = {
            name: SplitSide.of({**vars(side), "scenes": self.counts[name], "views": views[name]})
            for name, side in self.scenes.splits.items()
        }
        facts, (name, _) = self._executor.facts, split_weights(config.model)
        return asked.result(
            HardenResult,
            **self.paired(names),
            environment=",".join(taught.environments),
            objects=list(taught.objects),
            before=self._robust("before", names),
            after=self._robust("after", names),
            clean_before=self.clean.get("before"),
            clean_after=self.clean.get("after"),
            table=table,
            search=f"{config.policy_name}, {config.steps} steps",
            stronger_search=f"portfolio of pgd with restarts, cmaes and random, {scenes.TIMES * config.steps} steps",
            split=split,
            rounds=[
                each.model_copy(update={"kept": done and number == self.rounds.best})
                for number, each in enumerate(self.rounds.done)
            ],
            hardened=f"{name}@{weights}" if done and (name == "reference" or ":" in name) else None,  # or code makes it
            weights=str(weights) if done else None,
            pictures=str(self.run.path / ARTIFACTS / FOLDER) if done else None,
            shared=SharedWork.of_facts(facts, facts.machines if facts else {}),
            warnings=warnings,
            seconds=self.stages.seconds,
        )


def _share(right: int, count: int) -> Share:
    return Share(accuracy=right / count, interval=clopper_pearson(right, count), right=right, count=count)
