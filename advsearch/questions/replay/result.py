"""Settings and result of `replay`, and what is shown of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import ClassVar

from pydantic import Field, field_validator

from advsearch.extend import (
    AttackConfig,
    Config,
    ResultPart,
    SceneConfig,
    ShownResult,
    results,
    setting,
    setting_as_in,
    settings,
    views,
    wording,
)

WAYS = (
    "samples",
    "resolution",
    "depth",
    "integrator",
    "sampler",
    "denoiser",
    "curve",
    "jpeg",
    "sensor",
    "blender",
)
"""What a replay may change beside the model."""
REPLAY_TRIALS = 10
"""Half of an attack's: there are many rows, to be compared. The 95 % interval of 10 of
10 begins at 69 %.
"""


class ReplayConfig(Config):
    """Everything that decides what `replay` does: which run's adversarial scene is
    rendered again, and under what conditions.
    """

    command: ClassVar[str] = "replay"
    clashes: ClassVar[tuple[settings.Clash, ...]] = tuple(
        one for one in SceneConfig.clashes if one.setting == "overwrite"
    )

    attack: str = setting(
        ...,
        "replay",
        "the run whose adversarial scene is rendered again",
        "the name or the folder of a run of attack",
    )
    ways: str | None = setting(
        None,
        "replay",
        "what is changed, separated by commas",
        f"some of {', '.join(WAYS)}",
        otherwise="all",
    )
    model: str | None = setting(
        None, "replay", "other models that the scene is tried on, separated by commas", "models as `attack` takes them",
        otherwise="none",
    )  # fmt: skip
    trials: int = setting_as_in(
        AttackConfig, "trials", default=REPLAY_TRIALS, group="replay", description="fresh renders under each condition",
        expects="", otherwise="",
    )  # fmt: skip
    threads: int | None = setting_as_in(SceneConfig, "threads")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/RUN-replay-NNN")
    overwrite: bool = setting_as_in(SceneConfig, "overwrite")

    _named = settings.texts("attack", "run", several=["ways", "model"])
    _different = settings.each_once("ways")

    @field_validator("ways")
    @classmethod
    def _known_ways(cls, value: str | None) -> str | None:
        if value is not None and set(settings.split_names(value)) - set(WAYS):
            raise ValueError("an unknown way")
        return value

    @property
    def chosen(self) -> tuple[str, ...]:
        return WAYS if self.ways is None else settings.split_names(self.ways)

    @property
    def models(self) -> tuple[str, ...]:
        return () if self.model is None else settings.split_names(self.model)

    @property
    def title(self) -> tuple[str, ...]:
        return Path(self.attack).name, self.command


NOT_DONE = "not done"  # How a condition ends that could not be had


class ReplayRow(results.Fields):
    """One condition, and what is left of the adversarial scene under it."""

    way: str = Field(description="what is changed; `as verified` where nothing is")
    condition: str = Field(description="to what")
    ending: str = Field(
        description="`found` where the adversarial scene holds under it, as for an "
        "attack; or `not done`"
    )
    clean: results.ControlGroup | None = Field(
        None,
        description="trials of the clean scene under it, and in how many it is "
        "right; absent if not done",
    )
    verified: results.VerifiedRate | None = Field(
        None,
        description="trials of the adversarial scene, beside these; absent if not done",
    )
    reason: str = Field(
        "", description="why it was not done, and what to do; absent if it was"
    )


class ReplayResult(views.InNotebook, results.SceneResult):
    """The adversarial scene of a run under other conditions than it was searched and
    verified under.
    """

    command: ClassVar[str] = "replay"

    answer: str = Field(description="the run whose adversarial scene it is")
    answered: str = Field(description="how that run ended")
    table: list[ReplayRow]
    renders: int = Field(description="pictures that were rendered in this sitting")
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
        done = [row for row in self.table if row.ending != NOT_DONE]
        return (
            (f"holds under {sum(row.ending == 'found' for row in done)} of {len(done)}")
            if done
            else ""
        )


HEADS = (
    "changed",
    "to",
    "clean right",
    "95 % interval",
    "success",
    "95 % interval",
    "verdict",
)


def shown(result: ReplayResult) -> ShownResult:
    note = (
        "Trials with fresh seeds, the same under every condition, rounded to 8 bits, "
        "with 95 % Clopper-Pearson "
        "intervals. A success is what the search sought, where the clean scene is "
        "right with the same seed under the "
        "same condition."
    )
    rows = []
    for row in result.table:
        told = ["", "", "", "", f"{NOT_DONE}: {row.reason}"]
        if row.clean is not None and row.verified is not None:
            verdict = {"found": "holds", "already wrong": "clean is wrong too"}.get(
                row.ending, "does not hold"
            )
            told = [
                *wording.rated_cells(row.clean),
                *wording.rated_cells(row.verified),
                verdict,
            ]
        rows.append([row.way, "" if row.way == row.condition else row.condition, *told])
    table = ResultPart("Under other conditions", heads=HEADS, rows=rows, note=note)
    about = [
        f"{PurePath(result.answer).name} ({result.answered})",
        result.object,
        ", ".join(result.controls),
    ]
    return ShownResult(
        replay_text(result),
        [table],
        {"attack": result.answer, "model": result.model},
        about,
    )


def claims(result: ReplayResult) -> Iterator[views.Claim]:
    for row in result.table:
        name = f"the adversarial scene of {PurePath(result.answer).name}, {row.way}"
        name += "" if row.way == row.condition else f": {row.condition}"
        yield views.Claim.of_case(name, row.ending, row.verified)


def replay_text(result: ReplayResult) -> str:
    changed = [row for row in result.table[1:] if row.ending != NOT_DONE]
    if not result.table or (result.table[0].ending == NOT_DONE and not changed):
        return "Nothing was rendered again."
    own = "holds" if result.table[0].ending == "found" else "does not hold"
    own = "was not rendered" if result.table[0].ending == NOT_DONE else own
    held = [row for row in changed if row.ending == "found"]
    worthless = [row for row in changed if row.ending == "already wrong"]
    under = (
        f"changed, it holds under {len(held)} of {len(changed)} conditions"
        if changed
        else "no change was rendered"
    )
    text = f"As verified, the adversarial scene {own}; {under}."
    if worthless:
        names = ", ".join(f"{row.way}: {row.condition}" for row in worthless)
        text += f" The clean scene itself fails under {names}, where it says nothing."
    return text
