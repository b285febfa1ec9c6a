"""`harden`: trains a copy of a model on its worst cases, and measures it on what training never saw, before and
after."""

from __future__ import annotations

import gc
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from advsearch import seeds
from advsearch.api.keywords import asks, configured
from advsearch.attacks import clopper_pearson
from advsearch.attacks.trials import mcnemar
from advsearch.engine.journal import check_made_of
from advsearch.engine.naming import AnyModel, check_not_spread, check_run_settings, load_models, model_name
from advsearch.engine.record import Stages
from advsearch.errors import InputError, ModelError
from advsearch.models.reference import trainable
from advsearch.models.source import split_weights
from advsearch.progress import Watched, watcher
from advsearch.question import Asked
from advsearch.questions.attack.carry_out import LOADING, executor_for
from advsearch.questions.harden import scenes
from advsearch.questions.harden.detectors import DetectorCourse, Loss, read_coco
from advsearch.questions.harden.result import HardenConfig, HardenedControl, HardenResult, Share, SplitSide
from advsearch.questions.harden.rounds import PICTURES, WEIGHTS, Course, MakeOptimiser, Rounds
from advsearch.questions.harden.scenes import FURTHER, HELD_OUT, ROBUST, TRAINING, VALIDATION, SceneWork
from advsearch.questions.harden.segmenters import SegmenterCourse
from advsearch.questions.harden.training import ClassifierCourse, Examples
from advsearch.rooms import made_question
from advsearch.runs.directory import ARTIFACTS, RunDirectory, is_run, run_path
from advsearch.runs.results import SharedWork
from advsearch.runs.store import Row
from advsearch.tasks import make_task

MEANS = "means"  # the note of what a training has from Python
MEASUREMENTS = ("before", "stronger_before", "after", "stronger")
"""What is measured over each control, by its name in the table."""


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
        model: a classifier, a detector or a segmenter: what `load_model` takes, and no exported program.
        optimiser: makes one of the list of parameters, such as ``lambda p: torch.optim.SGD(p, 0.01)``; its learning
            rate is then the highest, in place of `rate`.
        beside: batches of further examples, such as a `DataLoader`: images (N, H, W, 3) sRGB in [0, 1], class indices
            (N,). One is taken with each step. Not of a detector, which `data` is for.
        loss: of a detector whose network returns none in training: a function of the network, its input (N, 3, H, W)
            and, for each picture, a mapping with "boxes" (K, 4), x0, y0, x1, y1 in pixels of that input, and "labels"
            (K,), indices of the model's labels; of a segmenter with "classes" (h, w) int64, the class that each pixel
            of its output should have, and "object" (h, w) bool, those of the object. It returns a number that is
            smaller where the network is better.
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
    finds, segments = config.task_name == "detection", config.task_name == "segmentation"
    places = finds or segments
    if not places and (config.task_name != "classification" or config.data or loss):
        raise InputError(
            "task: harden trains for classification, detection and segmentation; `data` is of detection, and `loss` of "
            "both of the others"
        )
    if segments and config.data:
        raise InputError("data: is of detection; leave it out")
    if places and beside is not None:
        raise InputError("beside: is of classifiers; give a detector a COCO folder as `data`")
    if places and config.layers != "all":
        raise InputError("layers: expected all of a detector or a segmenter; leave it out")
    try:
        (loaded, *_), warnings = load_models([model or config.model], make_task(config.task), config)
    except ModelError as error:
        if config.task_name != "classification":
            raise
        said = str(error).partition(": use `task=")[0]
        raise ModelError(f"{said}; harden trains classifiers, and with `task` detectors and segmenters") from error
    work = SceneWork(config, loaded, scenes.splits_of(config, loaded), asked.progress)
    student, means = trainable(loaded, config.layers, logits=not places), {"optimiser": optimiser is not None}
    course: Course[Any]
    if finds:
        own = [] if config.data is None else read_coco(Path(config.data), loaded)
        course, means["loss"] = DetectorCourse(work, student, optimiser, own, loss), loss is not None
    elif segments:
        course, means["loss"] = SegmenterCourse(work, student, optimiser, loss), loss is not None
    else:
        course, means["beside"] = ClassifierCourse(work, student, optimiser, beside), beside is not None
    _same_means(asked.run, means)
    check_made_of(asked.run, [loaded])
    run = Hardening(asked.run, course)
    with asked.until_interrupted():
        with executor_for(config, "advsearch.questions.harden.scenes:scenes_of", asked.progress) as work.executor:
            run.carry_out()
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
    """One run of `harden`. `wrong` says of what is measured, and of the number of a scene, whether it is not robust;
    `clean` how many plain pictures are right, before and after, of all."""

    def __init__(self, run: RunDirectory, course: Course[Any]) -> None:
        self.run, self.course, self.scenes, self.config = run, course, course.work, course.config
        self.rounds, self.stages = Rounds(run, course), Stages(course.work.progress)
        self.wrong = {(row.kind, row.step): bool(row.success) for row in run.store.rows()}
        self.clean: Mapping[str, Share] = {}
        searched, held_out = self.config.scenes * self.config.rounds, scenes.CLEAN_SCENES * self.config.measured
        self.counts = {
            TRAINING: searched, FURTHER: course.further * searched, VALIDATION: self.rounds.judged, HELD_OUT: held_out
        }  # fmt: skip

    def carry_out(self) -> None:
        """Measure, train, and measure again."""
        sides, stages = self.scenes.splits, self.stages
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
            looks = [scenes.Looking(number, weights) for number in range(self.counts[HELD_OUT])]
            right = [both for _, both in self.scenes.each("looking at plain pictures of held-out scenes", looks)]
            seen = len(right) * scenes.CLEAN_VIEWS
            self.clean = {
                name: _share(sum(both[k] for both in right), seen) for k, name in enumerate(("before", "after"))
            }
        finally:
            stages.end()
            gc.unfreeze()

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
        for place, ending in self.scenes.each(title, wanted, hint="`measured` and `steps` shorten it"):
            self._note(which, wanted[place].control, wanted[place].number, wrong=ending != ROBUST)

    def _note(self, which: str, control: str, number: int, *, wrong: bool) -> None:
        kind, seed = f"{which} {control}", seeds.stream(self.config.seed, f"measured {control}", number)
        self.wrong[kind, number] = wrong
        self.run.record(Row(kind, number, seed=seed, spp=self.config.verify_spp, success=wrong))

    def _robust(self, which: str, controls: Sequence[str]) -> list[bool] | None:
        """Whether each scene is robust to the searches over all of some controls; None where some are not known."""
        numbers = range(self.config.measured)
        wrong = [[self.wrong.get((f"{which} {control}", number)) for control in controls] for number in numbers]
        return None if any(None in each for each in wrong) else [not any(each) for each in wrong]

    def result(self, asked: Asked[HardenConfig], warnings: list[str]) -> HardenResult:
        """Return what is known."""
        config, done, table = self.config, asked.ending == "done", list[HardenedControl]()
        for control in config.controls:
            shares = {which: _share_of(self._robust(which, [control])) for which in MEASUREMENTS}
            if None not in shares.values():
                table.append(HardenedControl.of({"control": control, **shares}))
        before, after = (self._robust(which, list(config.controls)) for which in ("before", "after"))
        paired: dict[str, Any] = {}
        if before is not None and after is not None:
            pairs = list(zip(before, after, strict=True))
            gained, lost = pairs.count((False, True)), pairs.count((True, False))
            paired = {"gained": gained, "lost": lost, "p": mcnemar(gained, lost)}
        if done and self.rounds.best == 0:
            warnings = [*warnings, "No round kept the clean accuracy, so the weights are the model's own."]
        weights, taught = self.run.path / ARTIFACTS / WEIGHTS, self.scenes.splits[TRAINING]
        views = dict(zip(self.counts, (self.course.views[0], 1, self.course.views[1], scenes.CLEAN_VIEWS), strict=True))
        split = {
            name: SplitSide.of({**vars(side), "scenes": self.counts[name], "views": views[name]})
            for name, side in self.scenes.splits.items()
        }
        name, _ = split_weights(config.model)
        facts = self.scenes.executor and self.scenes.executor.facts
        return asked.result(
            HardenResult,
            **paired,
            environment=",".join(taught.environments),
            objects=list(taught.objects),
            before=_share_of(before),
            after=_share_of(after),
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
            pictures=str(self.run.path / ARTIFACTS / PICTURES) if done else None,
            shared=SharedWork.of_facts(facts, facts.machines if facts else {}),
            warnings=warnings,
            seconds=self.stages.seconds,
        )


def _share_of(flags: Sequence[bool] | None) -> Share | None:
    return None if flags is None else _share(sum(flags), len(flags))


def _share(right: int, count: int) -> Share:
    return Share(accuracy=right / count, interval=clopper_pearson(right, count), right=right, count=count)
