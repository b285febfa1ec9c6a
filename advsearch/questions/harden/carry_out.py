"""`harden`: trains a copy of a model on its worst cases, and measures both on what
training never saw.
"""

from __future__ import annotations

import gc
import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any

from advsearch.extend import (
    InputError,
    RunContext,
    RunDirectory,
    errors,
    results,
    seeds,
    statistics,
    workbench,
)
from advsearch.questions.harden import scenes
from advsearch.questions.harden.detectors import (
    DetectorCourse,
    Loss,
    SegmenterCourse,
    read_coco,
)
from advsearch.questions.harden.lessons import PICTURES
from advsearch.questions.harden.networks import trainable
from advsearch.questions.harden.result import (
    HardenConfig,
    HardenedControl,
    HardenResult,
    Share,
    SplitSide,
)
from advsearch.questions.harden.rounds import WEIGHTS, Course, MakeOptimiser, Rounds
from advsearch.questions.harden.scenes import (
    FURTHER,
    HELD_OUT,
    ROBUST,
    TRAINING,
    VALIDATION,
    SceneWork,
)
from advsearch.questions.harden.training import ClassifierCourse, Examples

MEANS = "means"  # the note of what a training has from Python
MEASUREMENTS = {
    "before": ("attacking the model as it is", None),
    "stronger_before": ("attacking it with a stronger search", "before"),
    "after": ("attacking the hardened model", None),
    "stronger": ("attacking it with a stronger search", "after"),
}
"""What is measured over each control, by its name in the table: what the progress says,
and of the stronger search that of the usual one. What that has found is not sought any
harder.
"""

COURSES: Mapping[str, Callable[..., Course]] = {
    "classification": ClassifierCourse,
    "detection": DetectorCourse,
    "segmentation": SegmenterCourse,
}


def hardened(
    asked: RunContext[HardenConfig],
    *,
    model: Any = None,
    optimiser: MakeOptimiser | None = None,
    beside: Examples | None = None,
    loss: Loss | None = None,
) -> HardenResult:
    """Harden a model as the settings say, or continue a run that was stopped.

    Args:
        asked: the settings and the run.
        model: a loaded one in place of the one that the settings name.
        optimiser, beside, loss: as for `advsearch.harden`.
    """
    config = asked.config
    asked.progress.stage(workbench.LOADING)
    workbench.check_run_settings(config)
    kind = config.task_name
    classifies = config.task_name == "classification"
    refused = {
        "task: harden trains for classification, detection and segmentation; `data` is "
        "of detection, and `loss` of "
        "both of the others": kind not in COURSES
        or (classifies and (config.data or loss)),
        "data: is of detection; leave it out": kind == "segmentation" and config.data,
        "beside: is of classifiers; give a detector a COCO folder as `data`": not classifies
        and beside is not None,
        "layers: expected all of a detector or a segmenter; leave it out": not classifies
        and config.layers != "all",
    }
    for text, wrong in refused.items():
        if wrong:
            raise InputError(text)
    try:
        task = workbench.make_task(config.task)
        (loaded, *_), warnings = workbench.load_models(
            [model or config.model], task, config
        )
    except errors.ModelError as error:
        if not classifies:
            raise
        text = str(error).partition(": use `task=")[0]
        raise errors.ModelError(
            f"{text}; harden trains classifiers, and with `task` detectors and "
            "segmenters"
        ) from error
    work = SceneWork(config, loaded, scenes.splits_of(config, loaded), asked.progress)
    student = trainable(loaded, config.layers, logits=classifies)
    given: dict[str, Any] = {"beside": beside} if classifies else {"loss": loss}
    more = {"own": read_coco(Path(config.data), loaded)} if config.data else {}
    course = COURSES[kind](work, student, optimiser, **given, **more)
    means = {
        name: value is not None
        for name, value in {"optimiser": optimiser, **given}.items()
    }
    before = json.loads(asked.run.store.note(MEANS) or "{}")
    asked.run.store.set_note(MEANS, json.dumps({**means, **before}))
    for name, was in before.items():
        if was != means[name]:
            raise InputError(
                f"{asked.run.path}: cannot resume: it began "
                f"{'with' if was else 'without'} `{name}`, which only Python "
                "gives; resume it with advsearch.harden(..., run=..., resume=True) and "
                "the same arguments"
            )
    workbench.check_made_of(asked.run, [loaded])
    run = Hardening(asked.run, course)
    worker = "advsearch.questions.harden.scenes:scenes_of"
    with asked.until_interrupted():
        with workbench.executor_for(config, worker, asked.progress) as work.executor:
            run.carry_out(asked)
    return run.result(asked, warnings)


class Hardening:
    """One run: `wrong` by measurement and number of a scene, `clean` for each plain
    picture whether it is right.
    """

    def __init__(self, run: RunDirectory, course: Course) -> None:
        self.run = run
        self.course = course
        self.scenes = course.work
        self.config = course.config
        self.rounds = Rounds(run, course)
        self.wrong = {
            (row.kind, row.step): bool(row.success) for row in run.store.rows()
        }
        self.clean: Mapping[str, list[bool]] = {}
        self.outcomes: Mapping[str, dict[str, int]] = {}
        searched = self.config.scenes * self.config.rounds
        held_out = scenes.CLEAN_SCENES * self.config.measured
        self.counts = {
            TRAINING: searched, FURTHER: course.further * searched, VALIDATION: self.rounds.judged, HELD_OUT: held_out
        }  # fmt: skip

    def carry_out(self, asked: RunContext[HardenConfig]) -> None:
        """Measure the model, train it, and measure it again; what is done is not done
        again.
        """
        stages = asked.stages
        sides = self.scenes.splits
        weights = b""
        scenes.check_disjoint(
            sides[HELD_OUT], [sides[name] for name in (TRAINING, FURTHER, VALIDATION)]
        )
        gc.freeze()  # as of `scenes_of`
        try:
            for which in MEASUREMENTS:
                if which == "after":
                    stages.begin("training", "training")
                    self.rounds.carry_out()
                    weights = (self.run.path / WEIGHTS).read_bytes()
                if "stronger" not in which:
                    stages.begin("measurement", MEASUREMENTS[which][0])
                self._measure(which, weights or None)
            looks = [
                partial(SceneWork.looked_at, number=number, weights=weights)
                for number in range(self.counts[HELD_OUT])
            ]
            right = [
                both
                for _, both in self.scenes.each(
                    "looking at plain pictures of held-out scenes", looks
                )
            ]
            self.clean = {
                when: [flag for both in right for flag in both[when]]
                for when in ("before", "after")
            }
            self.outcomes = {
                when: dict(
                    Counter(
                        outcome
                        for both in right
                        for outcome in both.get(f"outcomes {when}", ())
                    )
                )
                for when in ("before", "after")
            }
        finally:
            stages.end()
            gc.unfreeze()

    def _measure(self, which: str, weights: bytes | None) -> None:
        """Attack the model, as given or with other weights, on the held-out scenes
        where that is not measured yet.
        """
        title, usual = MEASUREMENTS[which]
        keys = [
            (control, number)
            for number, control in product(
                range(self.config.measured), self.config.controls
            )
            if (f"{which} {control}", number) not in self.wrong
        ]
        known = [
            key for key in keys if usual and self.wrong[f"{usual} {key[0]}", key[1]]
        ]
        sought = [key for key in keys if key not in known]
        times = scenes.TIMES if usual else 1
        attack = partial(SceneWork.attacked, times=times, weights=weights)
        attacks = [
            partial(attack, control=control, number=number)
            for control, number in sought
        ]
        endings = self.scenes.each(
            title, attacks, hint="`measured` and `steps` shorten it"
        )
        done = ((sought[place], ending != ROBUST) for place, ending in endings)
        for (control, number), wrong in chain(((key, True) for key in known), done):
            self.wrong[f"{which} {control}", number] = wrong
            seed = seeds.stream(self.config.seed, f"measured {control}", number)
            self.run.record_row(
                f"{which} {control}",
                number,
                seed=seed,
                spp=self.config.verify_spp,
                success=wrong,
            )

    def _robust(self, which: str, controls: Iterable[str]) -> list[bool] | None:
        """Whether each scene is robust to the searches over all of some controls; None
        where some are not known.
        """
        numbers = range(self.config.measured)
        wrong = [
            [self.wrong.get((f"{which} {control}", number)) for control in controls]
            for number in numbers
        ]
        return (
            None
            if any(None in each for each in wrong)
            else [not any(each) for each in wrong]
        )

    def result(
        self, asked: RunContext[HardenConfig], warnings: list[str]
    ) -> HardenResult:
        config = self.config
        done = asked.ending == "done"
        table = list[HardenedControl]()
        for control in config.controls:
            shares = {
                which: _share(self._robust(which, [control])) for which in MEASUREMENTS
            }
            if None not in shares.values():
                table.append(HardenedControl.of({"control": control, **shares}))
        before, after = (
            self._robust(which, config.controls) for which in ("before", "after")
        )
        paired: dict[str, Any] = {}
        if before is not None and after is not None:
            pairs = list(zip(before, after, strict=True))
            gained = pairs.count((False, True))
            lost = pairs.count((True, False))
            paired = {
                "gained": gained,
                "lost": lost,
                "p": statistics.paired.mcnemar(gained, lost),
            }
        if done and self.rounds.best == 0:
            warnings = [
                *warnings,
                "No round kept the clean accuracy, so the weights are the model's own.",
            ]
        path = self.run.path
        taught = self.scenes.splits[TRAINING]
        views = dict(
            zip(
                self.counts,
                (self.course.views[0], 1, self.course.views[1], scenes.CLEAN_VIEWS),
                strict=True,
            )
        )
        name = config.model.partition("@")[0].strip()
        facts = self.scenes.executor and self.scenes.executor.facts
        split = {
            side: SplitSide.of(
                {**vars(each), "scenes": self.counts[side], "views": views[side]}
            )
            for side, each in self.scenes.splits.items()
        }
        rounds = [
            each.model_copy(update={"kept": done and number == self.rounds.best})
            for number, each in enumerate(self.rounds.done)
        ]
        return asked.result(
            HardenResult, **paired, environment=",".join(taught.environments), objects=list(taught.objects),
            before=_share(before), after=_share(after),
            clean_before=_share(self.clean.get("before"), scenes.CLEAN_VIEWS, self.outcomes.get("before")),
            clean_after=_share(self.clean.get("after"), scenes.CLEAN_VIEWS, self.outcomes.get("after")),
            table=table, split=split, rounds=rounds,
            search=f"{config.policy_name}, {config.steps} steps",
            stronger_search="portfolio of pgd with restarts, cmaes and random, "
                            f"{scenes.TIMES * config.steps} steps",
            # a name with a colon is of code that makes it
            hardened=f"{name}@{path / WEIGHTS}" if done and (name == "reference" or ":" in name) else None,
            weights=str(path / WEIGHTS) if done else None,
            pictures=str(path / PICTURES) if done else None,
            shared=results.SharedWork.of_facts(facts, facts.machines if facts else {}), warnings=warnings,
            seconds=asked.stages.seconds,
        )  # fmt: skip


def _share(
    right: Sequence[bool] | None,
    views: int = 1,
    outcomes: Mapping[str, int] | None = None,
) -> Share | None:
    """Return the share of pictures that are right, so many `views` of each scene, one
    after the other, with its interval over scenes: views of one scene are not
    independent.
    """
    if right is None:
        return None
    right_views = [
        sum(right[first : first + views]) for first in range(0, len(right), views)
    ]
    interval = statistics.clustered.share_interval(
        right_views, [views] * len(right_views)
    )
    accuracy = sum(right) / len(right)
    counts = dict(outcomes or {}) or None
    return Share(
        accuracy=accuracy,
        interval=interval,
        right=sum(right),
        count=len(right),
        outcomes=counts,
    )
