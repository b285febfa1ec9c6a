"""Train a copy of a model on its worst cases, and measure both on held-out scenes."""

from __future__ import annotations

import gc
import json
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from advsearch.extend import (
    InputError,
    Model,
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
    DetectorTrainer,
    Loss,
    SegmenterTrainer,
    read_coco,
)
from advsearch.questions.harden.lessons import IMAGE_DIRECTORY
from advsearch.questions.harden.networks import make_trainable
from advsearch.questions.harden.result import (
    HardenConfig,
    HardenedControl,
    HardenResult,
    Share,
    SplitSide,
    TrainingRound,
)
from advsearch.questions.harden.rounds import (
    WEIGHTS_FILE,
    MakeOptimizer,
    Rounds,
    Trainer,
)
from advsearch.questions.harden.scenes import (
    FURTHER,
    HELD_OUT,
    ROBUST,
    TRAINING,
    VALIDATION,
    Job,
    SceneJobs,
)
from advsearch.questions.harden.training import ClassifierTrainer, Examples

ARGUMENTS_NOTE = "means"
"""Note of a run: which of the arguments that only Python can pass were passed."""


class Measurement(NamedTuple):
    """A search over each control in each measured scene.

    Attributes:
        title: title in the progress.
        weaker_measurement: name of the measurement with the usual search, if this one has a
            stronger search: where the usual one has found a wrong prediction, the
            stronger one is not run.
    """

    title: str
    weaker_measurement: str | None = None


MEASUREMENTS = {
    "before": Measurement("attacking the model as it is"),
    "stronger_before": Measurement("attacking it with a stronger search", "before"),
    "after": Measurement("attacking the hardened model"),
    "stronger": Measurement("attacking it with a stronger search", "after"),
}
"""Measurements by their name in the table, in the order in which they are made."""

TRAINERS: Mapping[str, Callable[..., Trainer]] = {
    "classification": ClassifierTrainer,
    "detection": DetectorTrainer,
    "segmentation": SegmenterTrainer,
}


def run_hardening(
    context: RunContext[HardenConfig],
    *,
    model: Any = None,
    optimiser: MakeOptimizer | None = None,
    beside: Examples | None = None,
    loss: Loss | None = None,
) -> HardenResult:
    """Harden a model, or continue a run that was stopped.

    Args:
        context: the settings and the run.
        model: loaded model that replaces the one that the settings name.
        optimiser: function from a list of parameters to an optimizer; None for the
            default one.
        beside: batches of the user's own images and class indices, which a classifier
            is trained with in addition.
        loss: training loss of a detector or a segmenter whose network returns none.
    """
    config = context.config
    context.progress.stage(workbench.LOADING)
    workbench.check_run_settings(config)
    check_settings(config, beside, loss)
    original_model, warnings = load_task_model(config, model)
    work = _make_scene_jobs(context, original_model)
    trainer = make_trainer(work, optimiser, examples=beside, loss=loss)
    arguments = _select_task_arguments(config, optimiser, beside, loss)
    check_same_arguments(context.run, arguments)
    workbench.check_digests(context.run, [original_model])

    hardening = Hardening(context.run, trainer)
    _execute_with_workers(context, hardening)
    return hardening.make_result(context, warnings)


def _make_scene_jobs(context: RunContext[HardenConfig], model: Model) -> SceneJobs:
    """Create what samples, renders and attacks the scenes of a run, for a model."""
    splits = scenes.make_splits(context.config, model)
    return SceneJobs(context.config, model, splits, context.progress)


def _select_task_arguments(
    config: HardenConfig,
    optimiser: MakeOptimizer | None,
    examples: Examples | None,
    loss: Loss | None,
) -> dict[str, Any]:
    """Return the Python arguments that the task uses, by their public names.

    Only these are compared with those of an earlier session: `beside` is for
    classifiers, `loss` for the other tasks.
    """
    if config.task_name == "classification":
        return {"optimiser": optimiser, "beside": examples}
    return {"optimiser": optimiser, "loss": loss}


def _execute_with_workers(
    context: RunContext[HardenConfig], hardening: Hardening
) -> None:
    """Execute a hardening until it ends or is interrupted, on workers if set."""
    config = context.config
    worker = "advsearch.questions.harden.scenes:load_scene_work"
    with context.until_interrupted():
        with workbench.open_executor(config, worker, context.progress) as executor:
            hardening.scene_jobs.executor = executor
            hardening.execute(context)


def make_trainer(
    work: SceneJobs,
    optimiser: MakeOptimizer | None,
    examples: Examples | None,
    loss: Loss | None,
) -> Trainer:
    """Create the trainer of a task, with a copy of the model that is trained.

    Args:
        work: the settings and the original model.
        optimiser: creates the optimizer; None for the trainer's own.
        examples: further batches of images, of a classifier.
        loss: loss of a detector or a segmenter; None for the network's own.
    """
    config = work.config
    is_classifier = config.task_name == "classification"
    student = make_trainable(work.model, config.layers, logits=is_classifier)
    arguments: dict[str, Any] = {"loss": loss}
    if is_classifier:
        arguments = {"beside": examples}
    if config.data:
        arguments["custom_items"] = read_coco(Path(config.data), work.model)
    return TRAINERS[config.task_name](work, student, optimiser, **arguments)


def check_settings(
    config: HardenConfig, beside: Examples | None, loss: Loss | None
) -> None:
    """Check that settings and Python arguments belong to the task.

    Args:
        config: the settings.
        beside: batches of the user's own images, for classifiers only.
        loss: loss for detectors and segmenters only.

    Raises:
        InputError: a setting or an argument belongs to another task.
    """
    _check_trained_task(config, loss)
    is_classifier = config.task_name == "classification"
    if config.task_name == "segmentation" and config.data:
        raise InputError("data: is for detection only; leave it out")
    if not is_classifier and beside is not None:
        raise InputError(
            "beside: is for classifiers only; give a detector a COCO folder as `data`"
        )
    if not is_classifier and config.layers != "all":
        raise InputError(
            "layers: expected `all` for a detector or a segmenter; leave it out"
        )


def _check_trained_task(config: HardenConfig, loss: Loss | None) -> None:
    """Check that there is a trainer for the task, and no argument it cannot use.

    Raises:
        InputError: there is none, or a classifier has images of detection or a loss.
    """
    is_classifier = config.task_name == "classification"
    uses_data_or_loss = bool(config.data or loss)
    if config.task_name not in TRAINERS or (is_classifier and uses_data_or_loss):
        raise InputError(
            "task: harden trains for classification, detection and segmentation; "
            "`data` is for detection only, and `loss` not for classification"
        )


def load_task_model(config: HardenConfig, model: Any = None) -> tuple[Model, list[str]]:
    """Load the model that is hardened, and return it with warnings.

    Raises:
        ModelError: it cannot be loaded, or is no model for the task.
    """
    try:
        task = workbench.make_task(config.task)
        models, warnings = workbench.load_models([model or config.model], task, config)
    except errors.ModelError as error:
        if config.task_name != "classification":
            raise
        # "classification" is the default task: perhaps the user named none. The end of a
        # message such as "...: use `task=depth`" is cut off, as harden may not train
        # for that task.
        reason, _, _ = str(error).partition(": use `task=")
        raise errors.ModelError(
            f"{reason}; harden trains classifiers, and with `task` detectors and "
            "segmenters"
        ) from error
    return models[0], warnings


def check_same_arguments(run: RunDirectory, arguments: Mapping[str, Any]) -> None:
    """Check that a resumed run gets each Python argument that it began with.

    Only whether an argument is passed is stored and compared, and not its value.

    Args:
        run: the run.
        arguments: arguments by name; None for those that were not passed.

    Raises:
        InputError: the run began with an argument that is missing, or without one that
            is passed.
    """
    is_passed = {name: value is not None for name, value in arguments.items()}
    was_passed = json.loads(run.store.read_note(ARGUMENTS_NOTE) or "{}")
    # Entries of an earlier session are not overwritten.
    run.store.write_note(ARGUMENTS_NOTE, json.dumps({**is_passed, **was_passed}))
    for name, began_with_it in was_passed.items():
        if began_with_it != is_passed[name]:
            preposition = "with" if began_with_it else "without"
            raise InputError(
                f"{run.path}: cannot resume: it began {preposition} `{name}`, which "
                "only Python can pass; resume it with advsearch.harden(..., run=..., "
                "resume=True) and the same arguments"
            )


class Hardening:
    """A run that measures a model, trains it, and measures it again.

    Attributes:
        is_wrong_by_search: whether a search found a wrong prediction, by the kind of
            its row, "MEASUREMENT CONTROL", such as "before texture", and the number of
            the scene.
        clean_is_right: whether the model is right about each plain image of the
            held-out scenes, "before" and "after".
        outcomes: counts of what becomes of the object in the plain images that are not
            right, such as {"missed": 3}, "before" and "after".
        n_scenes: number of scenes by split.
    """

    def __init__(self, run: RunDirectory, trainer: Trainer) -> None:
        """Prepare the run, with what an earlier session of it has measured."""
        self.run = run
        self.trainer = trainer
        self.scene_jobs = trainer.scene_jobs
        self.config = trainer.config
        self.rounds = Rounds(run, trainer)
        # the step of a row is the number of its scene, see `_record`
        self.is_wrong_by_search = {
            (row.kind, row.step): bool(row.success) for row in run.store.rows()
        }
        self.clean_is_right: dict[str, list[bool]] = {}
        self.outcomes: dict[str, dict[str, int]] = {}
        self.n_scenes = self._count_scenes()

    def _count_scenes(self) -> dict[str, int]:
        """Return the number of scenes of each split."""
        n_training = self.config.scenes * self.config.rounds
        return {
            TRAINING: n_training,
            FURTHER: self.trainer.n_further_scenes * n_training,
            VALIDATION: self.rounds.n_validation_scenes,
            # Plain images are cheaper than attacks, so they are evaluated in more scenes.
            HELD_OUT: scenes.CLEAN_SCENES * self.config.measured,
        }

    def execute(self, context: RunContext[HardenConfig]) -> None:
        """Measure the model, train it, and measure it again.

        A run that was stopped continues: what it has stored is not computed again.
        """
        splits = self.scene_jobs.splits
        # A scene that the model was trained on must not measure it.
        scenes.check_disjoint(
            splits[HELD_OUT], [splits[name] for name in (TRAINING, FURTHER, VALIDATION)]
        )
        # Garbage is collected after each scene. Frozen objects are not visited then,
        # which saves a sixth of the time.
        gc.freeze()
        try:
            self._measure_and_train(context)
        finally:
            context.stages.end()
            gc.unfreeze()

    def _measure_and_train(self, context: RunContext[HardenConfig]) -> None:
        """Measure the original model, train its copy, and measure the hardened model."""
        context.stages.begin("measurement", MEASUREMENTS["before"].title)
        self._measure("before", weights=None)
        # The stronger search has several policies and more steps. It shows whether
        # the model resists, or only has gradients that mislead the usual search.
        self._measure("stronger_before", weights=None)

        context.stages.begin("training", "training")
        self.rounds.execute()
        weights = (self.run.path / WEIGHTS_FILE).read_bytes()

        context.stages.begin("measurement", MEASUREMENTS["after"].title)
        self._measure("after", weights)
        self._measure("stronger", weights)
        self._evaluate_plain_images(weights)

    def _evaluate_plain_images(self, weights: bytes) -> None:
        """Evaluate the original and the hardened model on plain held-out images.

        Args:
            weights: weights of the hardened model, safetensors.
        """
        jobs = [
            partial(SceneJobs.evaluate_plain_images, number=number, weights=weights)
            for number in range(self.n_scenes[HELD_OUT])
        ]
        title = "looking at plain pictures of held-out scenes"
        # without the indices of the jobs: the order of the scenes does not matter
        evaluations = [value for _, value in self.scene_jobs.run_jobs(title, jobs)]
        for when in ("before", "after"):
            self._store_plain_evaluations(when, evaluations)

    def _store_plain_evaluations(
        self, when: str, evaluations: Sequence[Mapping[str, Any]]
    ) -> None:
        """Set `clean_is_right` and `outcomes` of one of the two models.

        Args:
            when: "before" or "after".
            evaluations: what `SceneJobs.evaluate_plain_images` has returned for each scene.
        """
        is_right = list[bool]()
        outcome_counts = Counter[str]()
        for evaluation in evaluations:
            is_right += evaluation[when]
            outcome_counts.update(evaluation.get(f"outcomes {when}", ()))
        self.clean_is_right[when] = is_right
        self.outcomes[when] = dict(outcome_counts)

    def _measure(self, name: str, weights: bytes | None) -> None:
        """Attack the model on the held-out scenes that are not measured yet.

        Args:
            name: a key of `MEASUREMENTS`.
            weights: the network's weights as bytes of a safetensors file; None for
                those that the model was loaded with.
        """
        measurement = MEASUREMENTS[name]
        steps_factor = 1
        if measurement.weaker_measurement is not None:
            steps_factor = scenes.STRONGER_STEPS_FACTOR
            # The stronger search is not run where the weaker one has found a failure.
            self._record_weaker(name, measurement.weaker_measurement)
        to_attack = self._list_unmeasured(name)
        jobs = _make_attack_jobs(to_attack, steps_factor, weights)
        statuses = self.scene_jobs.run_jobs(
            measurement.title, jobs, hint="`measured` and `steps` shorten it"
        )
        for index, status in statuses:
            control, number = to_attack[index]
            self._record(name, control, number, is_wrong=status != ROBUST)

    def _list_unmeasured(self, name: str) -> list[tuple[str, int]]:
        """Return the controls and scene numbers that a measurement has not done yet."""
        return [
            (control, number)
            for number, control in product(
                range(self.config.measured), self.config.controls
            )
            if (f"{name} {control}", number) not in self.is_wrong_by_search
        ]

    def _record_weaker(self, name: str, weaker: str) -> None:
        """Record the failures that the usual search found for the stronger one, too.

        A failure that a weaker search finds counts for the stronger search, which then
        need not be run in that scene. The weaker measurement is complete.

        Args:
            name: the measurement with the stronger search.
            weaker: the measurement with the usual search.
        """
        for control, number in self._list_unmeasured(name):
            if self.is_wrong_by_search[f"{weaker} {control}", number]:
                self._record(name, control, number, is_wrong=True)

    def _record(
        self, measurement: str, control: str, number: int, is_wrong: bool
    ) -> None:
        """Store whether an attack found a wrong prediction in a scene.

        Args:
            measurement: a key of `MEASUREMENTS`.
            control: control that was searched.
            number: number of the scene.
            is_wrong: whether it found a wrong prediction.
        """
        kind = f"{measurement} {control}"
        self.is_wrong_by_search[kind, number] = is_wrong
        self.run.append_row(
            kind,
            number,
            seed=seeds.derive_seed(self.config.seed, f"measured {control}", number),
            spp=self.config.verify_spp,
            success=is_wrong,
        )

    def _find_robust(
        self, measurement: str, controls: Collection[str]
    ) -> list[bool] | None:
        """Return whether each measured scene withstood the searches of all controls.

        None if the measurement is not complete.

        Args:
            measurement: a key of `MEASUREMENTS`.
            controls: controls of the searches.
        """
        is_robust = []
        for number in range(self.config.measured):
            is_wrong = [
                self.is_wrong_by_search.get((f"{measurement} {control}", number))
                for control in controls
            ]
            if None in is_wrong:  # not measured yet
                return None
            is_robust.append(not any(is_wrong))
        return is_robust

    def make_result(
        self, context: RunContext[HardenConfig], warnings: list[str]
    ) -> HardenResult:
        """Return the result of the run.

        If the run was stopped, values that are not measured yet are None.
        """
        config = self.config
        is_done = context.ending == "done"
        return context.result(
            HardenResult,
            **self._make_share_fields(),
            **self._list_files(is_done),
            **self._make_training_fields(is_done),
            table=self._make_control_rows(),
            search=f"{config.policy_name}, {config.steps} steps",
            stronger_search="portfolio of pgd with restarts, cmaes and random, "
            f"{scenes.STRONGER_STEPS_FACTOR * config.steps} steps",
            shared=self._describe_workers(),
            # a new list, to leave the caller's as it is
            warnings=[*warnings, *self._find_training_warnings(is_done)],
            seconds=context.stages.seconds,
        )

    def _make_share_fields(self) -> dict[str, Any]:
        """Return the fields with fractions of robust scenes and of right plain images."""
        before = self._find_robust("before", self.config.controls)
        after = self._find_robust("after", self.config.controls)
        return {
            **_compare_robustness(before, after),
            "before": make_share(before),
            "after": make_share(after),
            "clean_before": self._make_clean_share("before"),
            "clean_after": self._make_clean_share("after"),
        }

    def _make_training_fields(self, is_done: bool) -> dict[str, Any]:
        """Return the fields that state what the model was trained on, and its rounds."""
        training_split = self.scene_jobs.splits[TRAINING]
        return {
            "environment": ",".join(training_split.environments),
            "objects": list(training_split.objects),
            "split": self._make_split_rows(),
            "rounds": self._mark_best_round(is_done),
        }

    def _find_training_warnings(self, is_done: bool) -> list[str]:
        """Return a warning if the run is done, and its weights are the original ones."""
        # round 0 is the original network
        is_unchanged = self.rounds.best_round_number == 0
        if not (is_done and is_unchanged):
            return []
        return ["No round kept the clean accuracy, so the weights are the model's own."]

    def _mark_best_round(self, is_done: bool) -> list[TrainingRound]:
        """Return the rounds so far; once all are done, the best is marked."""
        return [
            training_round.model_copy(
                update={
                    "is_selected": is_done and number == self.rounds.best_round_number
                }
            )
            for number, training_round in enumerate(self.rounds.finished_rounds)
        ]

    def _list_files(self, is_done: bool) -> dict[str, str | None]:
        """Return the fields that name the files of the result; None before it is done."""
        if not is_done:
            return dict.fromkeys(("hardened", "weights", "pictures"))
        return {
            "hardened": self._make_hardened_name(),
            "weights": str(self.run.path / WEIGHTS_FILE),
            "pictures": str(self.run.path / IMAGE_DIRECTORY),
        }

    def _describe_workers(self) -> results.SharedWork | None:
        """Return how workers shared the scenes; None without workers."""
        executor = self.scene_jobs.executor
        if not executor or not executor.stats:
            return None
        stats = executor.stats
        return results.SharedWork.from_worker_stats(stats, stats.machines)

    def _make_clean_share(self, when: str) -> Share | None:
        """Return the fraction of right plain images; None if it is not measured.

        Args:
            when: "before" or "after".
        """
        return make_share(
            self.clean_is_right.get(when),
            views=scenes.CLEAN_VIEWS,
            outcomes=self.outcomes.get(when),
        )

    def _make_control_rows(self) -> list[HardenedControl]:
        """Return the robustness to each control that is measured."""
        rows = []
        for control in self.config.controls:
            shares = {
                measurement: make_share(self._find_robust(measurement, [control]))
                for measurement in MEASUREMENTS
            }
            if None not in shares.values():
                rows.append(HardenedControl.from_values({"control": control, **shares}))
        return rows

    def _make_split_rows(self) -> dict[str, SplitSide]:
        """Describe the parts of the split: objects, environments, scenes and views."""
        n_views = self._count_views()
        return {
            name: SplitSide(
                objects=list(split.objects),
                environments=list(split.environments),
                scenes=self.n_scenes[name],
                views=n_views[name],
            )
            for name, split in self.scene_jobs.splits.items()
        }

    def _count_views(self) -> dict[str, int]:
        """Return the number of views of a scene of each split."""
        training_views, validation_views = self.trainer.n_views
        return {
            TRAINING: training_views,
            FURTHER: 1,  # a new scene teaches more than another view
            VALIDATION: validation_views,
            HELD_OUT: scenes.CLEAN_VIEWS,
        }

    def _make_hardened_name(self) -> str | None:
        """Return the name that loads the hardened model; None if no name can."""
        # The name of a model is "NETWORK" or "NETWORK@WEIGHTS".
        network_name = self.config.model.partition("@")[0].strip()
        # A name with a colon, such as "mypackage:network", names the code of a network.
        can_be_loaded = network_name == "reference" or ":" in network_name
        if can_be_loaded:
            return f"{network_name}@{self.run.path / WEIGHTS_FILE}"
        return None


def _make_attack_jobs(
    to_attack: Sequence[tuple[str, int]], steps_factor: int, weights: bytes | None
) -> list[Job]:
    """Return the jobs that attack held-out scenes.

    Args:
        to_attack: control and number of the scene of each attack.
        steps_factor: multiple of the usual steps of a search.
        weights: bytes of a safetensors file; None for the original weights.
    """
    return [
        partial(
            SceneJobs.attack_held_out,
            steps_factor=steps_factor,
            weights=weights,
            control=control,
            number=number,
        )
        for control, number in to_attack
    ]


def _compare_robustness(
    before: Sequence[bool] | None, after: Sequence[bool] | None
) -> dict[str, Any]:
    """Return the fields of a result that compare scenes before and after.

    Args:
        before, after: whether each scene is robust, in the same order. If any of them
            is None, since it was not measured, there are no fields.
    """
    if before is None or after is None:
        return {}
    before_and_after = list(zip(before, after, strict=True))
    gained = before_and_after.count((False, True))
    lost = before_and_after.count((True, False))
    return {
        "gained": gained,
        "lost": lost,
        "p": statistics.paired.mcnemar(gained, lost),
    }


def make_share(
    is_right: Sequence[bool] | None,
    views: int = 1,
    outcomes: Mapping[str, int] | None = None,
) -> Share | None:
    """Return the fraction of right images with its interval over scenes.

    Args:
        is_right: whether each image is right (scenes * views), all views of a scene
            after each other; None if they are not measured.
        views: number of images of each scene, which are not independent.
        outcomes: counts of what happens to the object in the images that are not right,
            for example {"missed": 3}.
    """
    if is_right is None:
        return None
    return Share(
        accuracy=sum(is_right) / len(is_right),
        interval=_compute_interval_over_scenes(is_right, views),
        right=sum(is_right),
        count=len(is_right),
        outcomes=dict(outcomes or {}) or None,
    )


def _compute_interval_over_scenes(
    is_right: Sequence[bool], views: int
) -> tuple[float, float]:
    """Return the interval of an accuracy, with the views of a scene as one cluster.

    It is computed from the number of right views of each scene.
    """
    right_views = [
        sum(is_right[start : start + views]) for start in range(0, len(is_right), views)
    ]
    n_views = [views] * len(right_views)
    return statistics.clustered.rate_interval(right_views, n_views)
