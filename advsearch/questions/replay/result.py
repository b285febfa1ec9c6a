"""Settings and result of `replay`, and the views of its result."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath
from typing import ClassVar

from pydantic import Field, field_validator

from advsearch.extend import (
    AttackConfig,
    Config,
    SceneConfig,
    results,
    setting,
    setting_as_in,
    settings,
    statistics,
    views,
    wording,
)

RENDER_METHODS = (
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
"""Names of the changes of a replay, apart from another model."""
REPLAY_TRIALS = 10
"""Default number of trials, half of that of an attack, because there are many
conditions. The 95 % interval for 10 successes in 10 trials begins at 69 %.
"""


class ReplayConfig(Config):
    """Settings of `replay`: the adversarial scene, and the conditions."""

    command: ClassVar[str] = "replay"
    clashes: ClassVar[tuple[settings.Clash, ...]] = tuple(
        clash for clash in SceneConfig.clashes if clash.setting == "overwrite"
    )

    attack: str = setting(
        ...,
        "replay",
        "run whose adversarial scene is rendered again",
        "the name or the folder of a run of attack",
    )
    ways: str | None = setting(
        None,
        "replay",
        "conditions that are changed one at a time, separated by commas",
        f"some of {', '.join(RENDER_METHODS)}",
        otherwise="all, or with `backdrop` none",
    )
    backdrop: str | None = setting_as_in(
        SceneConfig,
        "backdrop",
        group="replay",
        description="other photographs in which the scene is rendered",
        expects="a folder of photographs with their camera files",
        otherwise="none",
    )
    model: str | None = setting(
        None,
        "replay",
        "other models that predict the scene, separated by commas",
        "models as `attack` takes them",
        otherwise="none",
    )
    trials: int = setting_as_in(
        AttackConfig,
        "trials",
        default=REPLAY_TRIALS,
        group="replay",
        description="fresh renders under each condition",
        expects="",
        otherwise="",
    )
    threads: int | None = setting_as_in(SceneConfig, "threads")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/RUN-replay-NNN")
    overwrite: bool = setting_as_in(SceneConfig, "overwrite")

    _named = settings.text_validator(
        "attack", "backdrop", "run", several=["ways", "model"]
    )
    _different = settings.unique_names_validator("ways")

    @field_validator("ways")
    @classmethod
    def _check_names(cls, value: str | None) -> str | None:
        """Reject a name that is not in `RENDER_METHODS`."""
        if value is not None and set(settings.split_names(value)) - set(RENDER_METHODS):
            raise ValueError("an unknown way")
        return value

    @property
    def selected_names(self) -> tuple[str, ...]:
        """The names of the conditions that are rendered."""
        if self.ways is not None:
            return settings.split_names(self.ways)
        return RENDER_METHODS if self.backdrop is None else ()

    @property
    def models(self) -> tuple[str, ...]:
        """The names of the other models."""
        return () if self.model is None else settings.split_names(self.model)

    @property
    def run_name_words(self) -> tuple[str, ...]:
        return Path(self.attack).name, self.command


NOT_DONE = "not done"
"""Status of a condition that could not be rendered."""
HOLDS = "found"
"""Status of a condition under which the adversarial scene is verified."""
CLEAN_IS_WRONG = "already wrong"
"""Status of a condition under which the model is wrong in the clean scene too."""


class ReplayRow(results.Fields):
    """Trials of the clean and of the adversarial scene under one condition."""

    change: str = Field(
        description="what is changed; `as verified` if nothing is changed"
    )
    condition: str = Field(description="what it is changed to")
    ending: str = Field(
        description="`found` if the adversarial scene holds under the condition; else "
        "another status as for an attack, or `not done`"
    )
    clean: results.ControlGroup | None = Field(
        None,
        description="trials of the clean scene under the condition, and in how many "
        "the model is right; absent if not done",
    )
    verified: results.VerifiedRate | None = Field(
        None,
        description="trials of the adversarial scene with the same seeds; absent if "
        "not done",
    )
    reason: str = Field(
        "", description="why it was not done, and what to do; absent if it was done"
    )


PHOTOGRAPH = "photograph"
"""Name of the conditions under which the scene is rendered into another photograph."""
SEARCHED_PHOTOGRAPH = "searched photograph"
"""Likewise, for the photographs that the search of the run itself used."""


class PhotographTransfer(results.Fields):
    """Counts of photographs in which an adversarial scene holds.

    It holds in a photograph if the model is wrong there, but right for the clean scene.
    """

    photographs: int = Field(
        description="number of photographs in which it was rendered"
    )
    clean_right: int = Field(
        description="number of these in which the model is right for the clean scene"
    )
    holding: int = Field(
        description="number of the latter in which the adversarial scene holds"
    )
    rate: results.Estimate | None = Field(
        description="`holding` / `clean_right`; null if `clean_right` is 0"
    )


class ReplayResult(views.InNotebook, results.SceneResult):
    """Whether an adversarial scene holds under other conditions."""

    command: ClassVar[str] = "replay"

    adversarial_run: str = Field(
        description="directory of the run with the adversarial scene"
    )
    run_ending: str = Field(description="status of that run")
    table: list[ReplayRow]
    transfer: PhotographTransfer | None = Field(
        None,
        description="counts of the photographs of `backdrop` that the search did not "
        "use; absent if there are none",
    )
    searched: PhotographTransfer | None = Field(
        None,
        description="likewise, counts of the photographs that the search used; absent "
        "if there are none",
    )
    renders: int = Field(
        description="number of images that were rendered since the run was last started"
    )
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def outcome_summary(self) -> str:
        """Where the adversarial scene holds, in a few words for lists of runs."""
        if self.transfer is not None:
            return (
                f"holds in {self.transfer.holding} of {self.transfer.clean_right} "
                "photographs"
            )
        done = [row for row in self.table if row.ending != NOT_DONE]
        if not done:
            return ""
        n_holding = sum(row.ending == HOLDS for row in done)
        return f"holds under {n_holding} of {len(done)}"


HEADS = (
    "changed",
    "to",
    "clean right",
    "95 % interval",
    "success",
    "95 % interval",
    "verdict",
)


TRIALS_NOTE = (
    "Trials have fresh seeds, the same under every condition, and images are rounded "
    "to 8 bits. Intervals are 95 % Clopper-Pearson intervals. A trial is a success if "
    "the adversarial scene has the prediction that the search was for, and the model is "
    "right for the clean scene with the same seed under the same condition."
)
VERDICTS = {HOLDS: "holds", CLEAN_IS_WRONG: "clean is wrong too"}
"""Verdicts by status; with any other status the scene does not hold."""


def count_transfer(
    table: Sequence[ReplayRow], method: str = PHOTOGRAPH
) -> PhotographTransfer | None:
    """Count in how many photographs an adversarial scene holds.

    A scene holds if the model is still wrong. The rate is among photographs in which
    the model is right for the clean scene. Each photograph counts once, whatever the
    number of trials. The result is None without photographs.

    Args:
        table: all rows.
        method: which rows count: `PHOTOGRAPH` for photographs that the attack did not
            use, `SEARCHED_PHOTOGRAPH` for those that it used.
    """
    rows = [row for row in table if row.change == method and row.ending != NOT_DONE]
    if not rows:
        return None
    n_clean_right = sum(row.ending != CLEAN_IS_WRONG for row in rows)
    n_holding = sum(row.ending == HOLDS for row in rows)
    return PhotographTransfer(
        photographs=len(rows),
        clean_right=n_clean_right,
        holding=n_holding,
        rate=_estimate_holding_rate(n_holding, n_clean_right),
    )


def _estimate_holding_rate(
    n_holding: int, n_clean_right: int
) -> results.Estimate | None:
    """Estimate the fraction of photographs in which a scene holds.

    It is among those in which the model is right for the clean scene; None without any.
    """
    if not n_clean_right:
        return None
    interval = statistics.intervals.clopper_pearson(n_holding, n_clean_right)
    return results.Estimate(value=n_holding / n_clean_right, interval=interval)


def describe_transfer(transfer: PhotographTransfer, kind: str = "other") -> str:
    """Return a sentence on the photographs in which an adversarial scene holds.

    It holds in a photograph if the model is wrong there, but right for the clean scene.

    Args:
        transfer: the counts.
        kind: kind of the photographs, an adjective.
    """
    clean = f"the clean scene is right in {transfer.clean_right} of them"
    photographs = wording.format_count(transfer.photographs, f"{kind} photograph")
    # Without a rate, the clean scene is right in no photograph.
    if transfer.rate is None or transfer.rate.interval is None:
        return f"It was tried in {photographs}: {clean}, so that they say nothing."
    interval = wording.format_interval(transfer.rate.interval)
    return (
        f"It was tried in {photographs}: {clean}, and of these it holds in "
        f"{transfer.holding} ({transfer.rate.value:.0%}, 95 % interval {interval})."
    )


def make_replay_view(result: ReplayResult) -> views.ShownResult:
    """Return the table of conditions, for a terminal or a page."""
    table = views.ResultPart(
        "Under other conditions",
        column_heads=HEADS,
        rows=[make_cells(row) for row in result.table],
        note=TRIALS_NOTE,
    )
    about = [
        f"{PurePath(result.adversarial_run).name} ({result.run_ending})",
        result.object,
        ", ".join(result.controls),
    ]
    facts = {"attack": result.adversarial_run, "model": result.model}
    return views.ShownResult(summarize_replay(result), [table], facts, about)


def make_cells(row: ReplayRow) -> list[str]:
    """Return the cells of a condition under `HEADS`.

    `format_rate_cells` returns two cells: the rate and its interval.
    """
    # The unchanged condition has the same text in both fields.
    condition = "" if row.change == row.condition else row.condition
    if row.clean is None or row.verified is None:
        return [row.change, condition, "", "", "", "", f"{NOT_DONE}: {row.reason}"]
    return [
        row.change,
        condition,
        *wording.format_rate_cells(row.clean),
        *wording.format_rate_cells(row.verified),
        VERDICTS.get(row.ending, "does not hold"),
    ]


def make_replay_claims(result: ReplayResult) -> Iterator[views.Claim]:
    """Yield a claim for each condition, and one over the photographs."""
    run_name = PurePath(result.adversarial_run).name
    for row in result.table:
        name = f"the adversarial scene of {run_name}, {row.change}"
        # The unchanged condition has the same text in both fields.
        if row.change != row.condition:
            name += f": {row.condition}"
        yield views.Claim.from_case(name, row.ending, row.verified)
    transfer = result.transfer
    if transfer is not None and transfer.rate is not None:
        yield _make_transfer_claim(transfer, transfer.rate)


def _make_transfer_claim(
    transfer: PhotographTransfer, rate: results.Estimate
) -> views.Claim:
    """Make the claim over the photographs, with its rate and interval."""
    extent = results.Extent.from_count(
        "photographs in which the clean scene is right and the adversarial one holds",
        transfer.holding,
        transfer.clean_right,
        rate.interval,
    )
    return views.Claim(
        kind="measured", statement=describe_transfer(transfer), extent=extent
    )


def summarize_replay(result: ReplayResult) -> str:
    """Summarize under which conditions the adversarial scene holds."""
    if all(row.ending == NOT_DONE for row in result.table):
        return "Nothing was rendered again."
    # The first row is the unchanged condition, which is rendered if any is.
    unchanged, *other_rows = result.table
    changed = [
        row
        for row in other_rows
        if row.ending != NOT_DONE
        and row.change not in (PHOTOGRAPH, SEARCHED_PHOTOGRAPH)
    ]
    has_photographs = result.transfer is not None or result.searched is not None
    text = f"As verified, the adversarial scene {_describe_unchanged(unchanged)}"
    text += f"{_describe_changes(changed, has_photographs)}."
    # other photographs than those of the search; then those of the search
    if result.transfer is not None:
        text += f" {describe_transfer(result.transfer)}"
    if result.searched is not None:
        text += f" {describe_transfer(result.searched, 'searched')}"
    return text + _describe_clean_failures(changed)


def _describe_changes(changed: Sequence[ReplayRow], has_photographs: bool) -> str:
    """Return under how many changed conditions the scene holds, to end a sentence.

    Args:
        changed: rows of the conditions that were rendered, without photographs.
        has_photographs: whether photographs were rendered, which other sentences count.
    """
    if changed:
        n_holding = sum(row.ending == HOLDS for row in changed)
        return f"; changed, it holds under {n_holding} of {len(changed)} conditions"
    return "" if has_photographs else "; no change was rendered"


def _describe_clean_failures(changed: Sequence[ReplayRow]) -> str:
    """Return a sentence on conditions where the clean scene is wrong; "" without any."""
    clean_wrong = [row for row in changed if row.ending == CLEAN_IS_WRONG]
    if not clean_wrong:
        return ""
    names = ", ".join(f"{row.change}: {row.condition}" for row in clean_wrong)
    return (
        f" The model is wrong for the clean scene, too, under {names}: these "
        "conditions show nothing about the adversarial scene."
    )


def _describe_unchanged(row: ReplayRow) -> str:
    """Return whether the scene holds under the unchanged condition, as a predicate."""
    if row.ending == HOLDS:
        return "holds"
    return "was not rendered" if row.ending == NOT_DONE else "does not hold"
