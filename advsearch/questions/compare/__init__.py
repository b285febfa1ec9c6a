"""Compare models, objects or adversarial scenes on the same pictures, pair by pair."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import ValidatorFunctionWrapHandler, field_validator, model_validator

from advsearch.config import SceneConfig
from advsearch.errors import InputError
from advsearch.experiment import PositionalArgument, RunContext, experiment
from advsearch.questions.compare.result import ComparedPair, ComparedSide, CompareResult, claims, shown
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.runs.directory import PARTS, find_run
from advsearch.runs.results import INTERRUPTED
from advsearch.settings import each_once, names_together, setting, setting_as_in, settings, split_names, texts

if TYPE_CHECKING:
    from advsearch.questions.compare.pairs import Side

ALWAYS = ("compared", "pictures", "seed", "threads", "deterministic", "run", "overwrite")
"""The settings that mean something for stored sweeps, too."""


class CompareConfig(SweepConfig):
    """Everything that decides what `compare` does: which stored sweeps it reads, or the sweep that it makes first."""

    command: ClassVar[str] = "compare"
    without: ClassVar[tuple[str, ...]] = (
        *("model", "adversarial_of", "surface", "aov", "metrics", "log", "trials", "verify_spp", "path", "shutter"),
        *("rolling", "fps", "must_change", "must_not_change"),
    )

    # fmt: off
    compared: str = setting(
        ..., "compare",
        "what is compared, separated by commas: sweeps that are stored (one of several models, or several of the same "
        "draws), or models, where `object` says what they are shown", "names or folders of runs of sweep, or models",
    )
    pictures: int = setting(
        6, "compare", "pictures of what one side alone gets right that are shown, for each side; 0 for none",
        unit="pictures", ge=0, le=1000,
    )
    object: str = setting_as_in(
        SweepConfig, "object", default="",
        description="the object that models are shown, where models are compared; several, separated by commas",
    )
    # fmt: on
    keep_pictures: Literal["all", "wrong", "none"] = setting_as_in(SweepConfig, "keep_pictures", default="wrong")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/WHAT-compare-NNN")

    _named = texts(several=["compared"])
    _different = each_once("compared")

    @field_validator("object", mode="wrap")
    @classmethod
    def _or_empty(cls, value: Any, read: ValidatorFunctionWrapHandler) -> Any:
        """Accept no object, which files have as an empty text."""
        return "" if value in ("", None) else read(value)

    @model_validator(mode="after")
    def _of_stored_or_made(self) -> CompareConfig:
        """Refuse what says how pictures are made where stored ones are compared, and a single model."""
        if not self.object:
            for asked in settings(type(self)):
                if asked.field not in ALWAYS and getattr(self, asked.field) != asked.default:
                    raise InputError(
                        f"{asked.name}: says how models are shown pictures, and no `object` is named; add `object`, or "
                        "leave it out to compare stored sweeps"
                    )
        elif len(split_names(self.compared)) < 2:
            raise InputError(f"compared: expected at least two models, got {self.compared[:60]}; name another one")
        return self

    @property
    def title(self) -> tuple[str, ...]:
        return "-".join(Path(name).stem for name in split_names(self.object or self.compared)), self.command

    def sweep(self) -> SweepConfig:
        """Return the sweep of the models that has to be made first."""
        return SweepConfig.of(self, model=self.compared, trials=0)


@experiment(
    "compare mug-sweep-001",
    "compare mug-sweep-001 mug-sweep-002 --json",
    "compare reference hardened.pt2 --object mug --control pose,camera --samples 200",
    positional_args=("compared",),
    about="compared",
    positional=PositionalArgument("WHAT", "the run of a sweep, or models and what they are shown", "", True),
    view=shown,
    claims=claims,
)
def compare(asked: RunContext[CompareConfig]) -> CompareResult:
    """Compare models, objects or adversarial scenes on the same pictures, pair by pair (docs/compare.md).

    All other arguments are the settings of `advsearch compare`. The run is kept, in `run` or under runs/. Models that
    exist in Python alone are swept first (`sweep(scene, [one, other], run=...)`), and then the run is compared.

    Args:
        compared: names or folders of runs of `sweep`: one of several models, or several of the same draws. With
            `object`, names of models, which are shown it first.
    """
    # these import torch and pandas
    from advsearch.experiment import run_part as carry_out_part
    from advsearch.questions.compare.pairs import PairPictures, compared, differing, read_sides
    from advsearch.rules import interval_of, share_of
    from advsearch.runs.tables import count_wrong_outcomes

    config, progress, renders = asked.config, asked.progress, 0
    if config.object:
        swept = asked.run.path / PARTS / "sweep"
        done = carry_out_part(swept, config.sweep().with_only_here(config.only_here), progress)
        renders = sum(getattr(done, "renders", {}).values())
        sides = [] if done.goes_on else read_sides([swept])
    else:
        progress.stage("reading rows")
        sides = read_sides([find_run(name) for name in split_names(config.compared)])
    differ = differing(sides) if sides else []
    pictures, pairs, warnings = PairPictures(asked), list[ComparedPair](), _cautions(sides, differ)
    for number, other in enumerate(sides[1:], start=1):
        progress.stage("counting pairs")
        try:
            pair = compared(sides[0], other, config.seed)
        except InputError as error:  # the library that finds rules is missing
            warnings.append(f"Where one side is worse was not looked for: {error}")
            pair = compared(sides[0], other, config.seed, rules=False)
        pairs.append(pair.model_copy(update={"shown": list(pictures.of(sides[0], other, number))}))
    if not sides:
        asked.ending = INTERRUPTED
    return asked.result(
        CompareResult,
        environment=names_together(side.summary.environment for side in sides) or config.lit_by,
        controls=sides[0].summary.controls if sides else list(config.controls),
        object=names_together(side.named["object"] for side in sides) or config.object,
        model=names_together(side.named["model"] for side in sides) or config.compared,
        task=sides[0].summary.task if sides else config.task_name,
        differ=differ,
        sides=[
            ComparedSide(
                name=side.name,
                run=str(side.folder),
                **side.named,
                configurations=len(side.rows),
                correct=int(side.right.sum()),
                accuracy=share_of(side.rows),
                interval=interval_of(side.rows),
                outcomes=count_wrong_outcomes(side.rows),
                seconds=float(side.rows["seconds"].mean()),
            )
            for side in sides
        ],
        pairs=pairs,
        renders=renders + pictures.rendered,
        warnings=list(dict.fromkeys([*warnings, *pictures.warnings])),
    )


def _cautions(sides: Sequence[Side], names: Sequence[str]) -> list[str]:
    if not sides:
        return []
    cautions = [text for side in sides for text in side.summary.warnings]
    if len(names) > 1:
        listed = f"{', '.join(names[:-1])} and {names[-1]}"
        cautions.append(f"The sweeps differ in {listed}: what is told here is of all of that together.")
    if not names:
        cautions.append("The sweeps have the same settings: what differs is in files, in versions, or in the machine.")
    if len(sides[0].rows) > 1 and sides[0].rows["unit"].nunique() == 1:
        name = sides[0].rows.attrs["unit name"]
        cautions.append(f"All pairs are of one {name}: the shares are of this one, and nothing is shown of others.")
    tasks = {side.summary.task for side in sides}
    if len(tasks) > 1:
        cautions.append(f"What counts as right is judged by different tasks: {', '.join(sorted(tasks))}.")
    return cautions
