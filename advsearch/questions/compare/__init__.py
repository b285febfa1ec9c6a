"""Compare models, objects or adversarial scenes on the same pictures, pair by pair."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import ValidatorFunctionWrapHandler, field_validator, model_validator

from advsearch.extend import (
    InputError,
    PositionalArgument,
    RunContext,
    RunDirectory,
    SceneConfig,
    SweepConfig,
    directory,
    experiment,
    results,
    setting,
    setting_as_in,
    settings,
)
from advsearch.questions.compare.result import (
    ComparedPair,
    ComparedSide,
    CompareResult,
    make_compare_claims,
    make_compare_view,
)

if TYPE_CHECKING:
    from advsearch.questions.compare.images import PairImages
    from advsearch.questions.compare.sides import Side

STORED_SWEEP_SETTINGS = (
    "compared",
    "pictures",
    "seed",
    "threads",
    "deterministic",
    "run",
    "overwrite",
)
"""The settings that also apply where stored sweeps are compared."""


class CompareConfig(SweepConfig):
    """Settings of `compare`: the stored sweeps that it reads, or the sweep that it
    runs.
    """

    command: ClassVar[str] = "compare"
    excluded_settings: ClassVar[tuple[str, ...]] = (
        "model",
        "adversarial_of",
        "surface",
        "aov",
        "metrics",
        "log",
        "trials",
        "verify_spp",
        "path",
        "shutter",
        "rolling",
        "fps",
        "must_change",
        "must_not_change",
        "twins",
    )

    # fmt: off
    compared: str = setting(
        ..., "compare",
        "what is compared, separated by commas: stored sweeps (one sweep of several "
        "models, or several sweeps of the same draws); or, if `object` is set, models "
        "that are swept over that object first",
        "names or folders of runs of sweep, or models",
    )
    pictures: int = setting(
        6, "compare", "number of pictures to show, for each side, that only this side "
                      "gets right; 0 for none",
        unit="pictures", ge=0, le=1000,
    )
    object: str = setting_as_in(
        SweepConfig, "object", default="",
        description="the object that models are compared on; several, separated by "
                    "commas",
    )
    # fmt: on
    keep_pictures: Literal["all", "wrong", "none"] = setting_as_in(
        SweepConfig, "keep_pictures", default="wrong"
    )
    run: str | None = setting_as_in(
        SceneConfig, "run", otherwise="runs/WHAT-compare-NNN"
    )

    _named = settings.text_validator(several=["compared"])
    _different = settings.unique_names_validator("compared")

    @field_validator("object", mode="wrap")
    @classmethod
    def _accept_no_object(cls, value: Any, read: ValidatorFunctionWrapHandler) -> Any:
        """Accept a missing object, which files store as an empty string."""
        return "" if value in ("", None) else read(value)

    @model_validator(mode="after")
    def _check_settings(self) -> CompareConfig:
        """Reject settings that do not belong to what is compared.

        Without an `object`, stored sweeps are compared. They take no settings of a new
        sweep. With an `object`, models are compared; at least two are needed.
        """
        compares_stored_sweeps = not self.object
        if compares_stored_sweeps:
            self._check_no_sweep_settings()
        elif len(settings.split_names(self.compared)) < 2:
            raise InputError(
                "compared: expected at least two models, got "
                f"{self.compared[:60]}; name another one"
            )
        return self

    def _check_no_sweep_settings(self) -> None:
        """Check that no setting of a new sweep is set.

        Raises:
            InputError: one is set.
        """
        for declared in settings.settings(type(self)):
            # `field` is the name in Python, `name` the one that users type.
            is_set = getattr(self, declared.field) != declared.default
            if is_set and declared.field not in STORED_SWEEP_SETTINGS:
                raise InputError(
                    f"{declared.name}: says how models are shown pictures, and no "
                    "`object` is named; add `object`, "
                    "or leave it out to compare stored sweeps"
                )

    @property
    def run_name_words(self) -> tuple[str, ...]:
        names = settings.split_names(self.object or self.compared)
        return "-".join(Path(name).stem for name in names), self.command

    def make_sweep_config(self) -> SweepConfig:
        """Return the settings of the sweep of the models, which has to run first."""
        return SweepConfig.from_config(self, model=self.compared, trials=0)


@experiment(
    "compare mug-sweep-001",
    "compare mug-sweep-001 mug-sweep-002 --json",
    "compare reference hardened.pt2 --object mug --control pose,camera --samples 200",
    positional_args=("compared",),
    about="compared",
    positional=PositionalArgument(
        "WHAT", "the run of a sweep, or models and what they are shown", "", True
    ),
    view=make_compare_view,
    claims=make_compare_claims,
)
def compare(context: RunContext[CompareConfig]) -> CompareResult:
    """Compare models, objects or adversarial scenes pair by pair (docs/compare.md).

    All other arguments are the settings of `advsearch compare`. The run is saved in the
    directory `run`, or in a new one under runs/. Models that exist in Python only are
    swept first, by `sweep(scene, [first_model, second_model], run=...)`, and then that
    run is compared.

    Args:
        compared: names or directories of runs of `sweep`: one run of several models, or
            several runs that sampled the same scenes. With `object` they are names of
            models, which are swept over that object first.
    """
    # these import torch and pandas
    from advsearch.questions.compare.images import PairImages
    from advsearch.questions.compare.sides import find_different_settings

    sides, n_sweep_renders = load_sides(context)
    if not sides:  # the sweep of the models was interrupted
        context.ending = results.INTERRUPTED
    differ = find_different_settings(sides) if sides else []
    warnings = find_comparison_warnings(sides, differ)
    images = PairImages(context)
    pairs = _compare_with_first(images, sides, warnings)
    return context.result(
        CompareResult,
        **describe_sweeps(context.config, sides),
        differ=differ,
        sides=[count_side(side) for side in sides],
        pairs=pairs,
        renders=n_sweep_renders + images.n_rendered,
        warnings=list(dict.fromkeys([*warnings, *images.warnings])),
    )


def _compare_with_first(
    images: PairImages, sides: Sequence[Side], warnings: list[str]
) -> list[ComparedPair]:
    """Compare the first side with each of the others.

    Args:
        images: collects images of pairs, for the run of its context.
        sides: the sides; there are no pairs without sides.
        warnings: gets a warning where rules cannot be found.
    """
    context = images.context
    pairs: list[ComparedPair] = []
    for number, side in enumerate(sides[1:], start=1):
        context.progress.stage("counting pairs")
        pair = _count_pair(sides[0], side, context.config.seed, warnings)
        examples = list(images.list_examples(sides[0], side, number))
        pairs.append(pair.model_copy(update={"discordant_pictures": examples}))
    return pairs


def _count_pair(
    first: Side, second: Side, seed: int, warnings: list[str]
) -> ComparedPair:
    """Count the pairs of two sides, without rules if scikit-learn is not installed.

    Args:
        first, second: the sides.
        seed: seed that splits the pairs in halves.
        warnings: gets a warning if there are no rules.
    """
    from advsearch.questions.compare.pairs import compare_sides  # imports pandas

    try:
        return compare_sides(first, second, seed)
    except InputError as error:
        # scikit-learn, which finds rules, is not installed (`compare_sides`)
        warnings.append(f"Where one side is worse was not looked for: {error}")
        return compare_sides(first, second, seed, with_rules=False)


def load_sides(context: RunContext[CompareConfig]) -> tuple[list[Side], int]:
    """Read the sides of stored sweeps, or of a new sweep of models.

    A side is a set of predictions, such as those of one model.

    Returns:
        The sides, and the number of images that a new sweep rendered. There are no
        sides if the new sweep was interrupted.
    """
    from advsearch.questions.compare.sides import read_sides  # imports pandas

    config = context.config
    if not config.object:
        context.progress.stage("reading rows")
        names = settings.split_names(config.compared)
        return read_sides([directory.find_run(name) for name in names]), 0
    sweep_config = config.make_sweep_config()
    # Models that exist only in Python are no settings, and are passed in addition.
    sweep_config = sweep_config.with_python_parts_of(config)
    sweep = context.run_part("sweep", sweep_config)
    # `run_part` returns the result of any command; that of a sweep has `renders`.
    n_renders = sum(getattr(sweep, "renders", {}).values())
    if sweep.is_unfinished:
        return [], n_renders
    return read_sides([RunDirectory.locate_part(context.run.path, "sweep")]), n_renders


def describe_sweeps(config: CompareConfig, sides: Sequence[Side]) -> dict[str, Any]:
    """Return the fields of the result that describe the compared sweeps.

    There are no sides if the sweep was interrupted.
    """
    if not sides:
        return _describe_planned_sweep(config)
    environments = settings.join_names(side.sweep.summary.environment for side in sides)
    objects = settings.join_names(side.name_by_column["object"] for side in sides)
    models = settings.join_names(side.name_by_column["model"] for side in sides)
    return {
        "environment": environments or config.environment_name,
        "controls": sides[0].sweep.summary.controls,
        "object": objects or config.object,
        "model": models or config.compared,
        "task": sides[0].sweep.summary.task,
    }


def _describe_planned_sweep(config: CompareConfig) -> dict[str, Any]:
    """Return the fields of the result that describe a sweep, from its settings."""
    return {
        "environment": config.environment_name,
        "controls": list(config.controls),
        "object": config.object,
        "model": config.compared,
        "task": config.task_name,
    }


def count_side(side: Side) -> ComparedSide:
    """Count how often the model is right with a side."""
    from advsearch.extend import rules  # imports pandas

    return ComparedSide(
        name=side.name,
        run=str(side.sweep.folder),
        object=side.name_by_column["object"],
        model=side.name_by_column["model"],
        adversarial_run=side.name_by_column["answer"],
        configurations=len(side.rows),
        correct=int(side.is_right.sum()),
        accuracy=rules.estimate_rate(side.rows),
        interval=rules.estimate_interval(side.rows),
        outcomes=rules.count_wrong_outcomes(side.rows),
        seconds=float(side.rows["seconds"].mean()),
    )


def find_comparison_warnings(sides: Sequence[Side], differ: Sequence[str]) -> list[str]:
    """Return warnings about the sides of a comparison.

    Args:
        sides: the predictions that are compared, such as those of two models.
        differ: names of the settings in which their sweeps differ, for example
            ["model"].
    """
    if not sides:
        return []
    warnings = [text for side in sides for text in side.sweep.summary.warnings]
    warnings += _find_setting_warnings(differ)
    warnings += _find_unit_warnings(sides[0].rows)
    tasks = {side.sweep.summary.task for side in sides}
    if len(tasks) > 1:
        warnings.append(
            f"Different tasks decide what counts as right: {', '.join(sorted(tasks))}."
        )
    return warnings


def _find_setting_warnings(differ: Sequence[str]) -> list[str]:
    """Return a warning if sweeps differ in several settings, or in none.

    A difference in one setting is what a comparison is about.
    """
    if not differ:
        return [
            "The sweeps have the same settings: a difference comes from files, "
            "versions, or the machine."
        ]
    if len(differ) == 1:
        return []
    names = f"{', '.join(differ[:-1])} and {differ[-1]}"
    return [
        f"The sweeps differ in {names}: a difference between the sides may come "
        "from any of these."
    ]


def _find_unit_warnings(rows: Any) -> list[str]:
    """Return a warning if several rows of a side are all of one unit, such as a drive.

    Rows of one unit, such as the frames of one drive, are not independent.
    """
    is_of_single_unit = rows["unit"].nunique() == 1
    if len(rows) <= 1 or not is_of_single_unit:
        return []
    unit_name = rows.attrs["unit name"]
    return [
        f"All pairs are of one {unit_name}: the fractions are those of this one, "
        "and show nothing about others."
    ]
