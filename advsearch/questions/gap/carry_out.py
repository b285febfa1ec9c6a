"""`gap`: the worst case beside the average, over the same space and budget, for each object and each control."""

from __future__ import annotations

from pathlib import Path

from typing_extensions import Unpack

from advsearch.api.keywords import GapKeywords, asks, configured
from advsearch.api.studies import StudyRun, carry_out_study
from advsearch.engine.loading import Scene
from advsearch.engine.naming import AnyModel
from advsearch.progress import Progress, Watched, watcher
from advsearch.questions.gap.answer import GapResult, GapRow
from advsearch.questions.gap.settings import GapConfig
from advsearch.runs.results.attack import AttackSummary, AverageCase


@asks(GapConfig, GapKeywords)
def gap(
    object: Scene | str | Path,
    model: AnyModel = "reference",
    *,
    progress: Watched = None,
    **settings: Unpack[GapKeywords],
) -> GapResult:
    """Compare the worst configuration with the average, for each object and each control (docs/questions.md).

    Args:
        object: from `load_scene`, or names of objects, or files of them, separated by commas.
    """
    config = configured(GapConfig, object=object, model=model, **settings)
    return gap_from_config(config, progress=watcher(progress))


def gap_from_config(config: GapConfig, *, progress: Progress | None = None, resumed: Path | None = None) -> GapResult:
    """Do what a configuration describes; arguments as for `advsearch.api.carry_out`."""
    return carry_out_study(
        config, _compared, lambda rows, common: GapResult(**vars(common), table=rows), progress, resumed
    )


def _compared(study: StudyRun) -> list[GapRow]:
    rows = []
    for (one,) in study.chains:
        summary = study.attack(one)
        if summary is not None and summary.average is not None:
            rows.append(_row(one.config.object, one.of, summary, summary.average))
    return rows


def _row(name: str, control: str, summary: AttackSummary, average: AverageCase) -> GapRow:
    return GapRow(
        object=name,
        control=control,
        average=average,
        worst=summary.verified,
        ending=summary.ending,
        margin=summary.verified.margin if summary.verified else None,
        renders=summary.renders,
        run=summary.run,
    )
