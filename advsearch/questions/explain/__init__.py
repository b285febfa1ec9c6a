"""Say in words where a model is wrong, from the rows of sweeps, and confirm it by fresh renders."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from advsearch.config import SceneConfig
from advsearch.errors import InputError
from advsearch.experiment import PositionalArgument, RunContext, experiment
from advsearch.questions.explain.result import ExplainResult, RuleRow, claims, shown, triggering
from advsearch.runs.directory import PARTS, find_run
from advsearch.runs.results import INTERRUPTED
from advsearch.runs.summary import read_result
from advsearch.settings import Clash, Config, each_once, names_together, setting, setting_as_in, split_names, texts


class ExplainConfig(Config):
    """Everything that decides what `explain` does: whose rows it reads, and what it renders to see whether it is so."""

    command: ClassVar[str] = "explain"
    clashes: ClassVar[tuple[Clash, ...]] = tuple(one for one in SceneConfig.clashes if one.setting == "overwrite")

    # fmt: off
    sweeps: str = setting(
        ..., "explain", "the sweeps whose rows are read together, separated by commas",
        "names or folders of runs of sweep, or of recipes with sweeps",
    )
    confirm: int = setting(
        100, "explain", "fresh configurations inside each rule that are rendered to confirm it; 0 for none",
        unit="renders", ge=0, le=100_000,
    )
    pairs: int = setting(
        12, "explain", "failures for which the nearest right configuration is looked for; 0 for none",
        unit="failures", ge=0, le=100,
    )
    clusters: int = setting(
        100, "explain", "failures that are rendered again and grouped by what the model decides by; 0 for none",
        unit="failures", ge=0, le=10_000,
    )
    # fmt: on
    accuracy: float = setting(
        0.95, "explain", "accuracy that the envelope promises, at 95 % confidence", gt=0.0, le=0.999
    )
    seed: int = setting_as_in(SceneConfig, "seed")
    threads: int | None = setting_as_in(SceneConfig, "threads")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/RUN-explain-NNN")
    overwrite: bool = setting_as_in(SceneConfig, "overwrite")

    _named = texts("run", several=["sweeps"])
    _different = each_once("sweeps")

    @property
    def title(self) -> tuple[str, ...]:
        return Path(split_names(self.sweeps)[0]).name, self.command


@experiment(
    "explain mug-sweep-001",
    "explain mug-sweep-001 mug-sweep-002 --confirm 200 --accuracy 0.9",
    "explain mug-sweep-001 --confirm 0 --pairs 0 --json",
    positional_args=("sweeps",),
    about="sweeps",
    positional=PositionalArgument("RUN", "the run of a sweep", "", True),
    view=shown,
    claims=claims,
    triggering=triggering,
)
def explain(asked: RunContext[ExplainConfig]) -> ExplainResult:
    """Say in words where a model is wrong, from the rows of sweeps, and confirm it by renders (docs/explain.md).

    Args:
        sweeps: name or folder of a run of `sweep` that has ended, or several, whose rows are read together; of a
            recipe, its sweeps.
    """
    # these import torch, scipy and pandas
    from advsearch.questions.explain import findings
    from advsearch.questions.explain.renders import AskedSweep, Renders, read_predictions
    from advsearch.rules import FEWEST_ROWS, find_rules, halves, is_shown, observed

    config, progress = asked.config, asked.progress
    progress.stage("reading rows")
    sweeps = [AskedSweep.of(folder) for name in split_names(config.sweeps) for folder in _sweeps_of(find_run(name))]
    rows = read_predictions(sweeps)
    rows = rows[is_shown(rows)].reset_index(drop=True)
    if len(rows) < FEWEST_ROWS:
        raise InputError(f"explain: expected at least {FEWEST_ROWS} rows, got {len(rows)}; sweep more configurations")
    table = observed(rows, rows.attrs["units"])
    if not table.attrs["units"]:
        raise InputError("explain: expected rows in which something varies that all of them have, got none")
    choosing, counting = halves(table, config.seed)
    progress.stage("seeking rules on one half of the rows")
    found = find_rules(choosing, counting, config.seed)
    progress.stage("measuring which parameters matter")
    importance = findings.find_importance(table)
    box = findings.find_envelope(choosing, counting, config.accuracy)
    renders = Renders(asked, sweeps, rows, table)
    rules = [
        RuleRow(**findings.rule_counts(one), confirmed=renders.confirmed(found.told, n))
        for n, one in enumerate(found.told)
    ]
    pairs = list(renders.pairs(found.told))
    clusters = renders.clusters()
    if renders.interrupted:
        asked.ending = INTERRUPTED
    counted = findings.right_of(table)
    return asked.result(
        ExplainResult,
        sweeps=[str(sweep.folder) for sweep in sweeps],
        object=names_together(sweep.summary.object for sweep in sweeps),
        model=names_together(sweep.summary.model for sweep in sweeps),
        environment=names_together(sweep.summary.environment for sweep in sweeps),
        controls=sweeps[0].summary.controls,
        parameters=list(table.attrs["units"]),
        **vars(counted),
        units=None if table["unit"].is_unique else table["unit"].nunique(),
        rules=rules,
        not_told=findings.not_told(found.next, len(table)),
        importance=importance,
        envelope=box,
        pairs=pairs,
        pairs_sought=renders.pairs_sought,
        clusters=clusters,
        renders=renders.count,
        warnings=[*renders.warnings, *findings.cautions(table, importance)],
    )


def _sweeps_of(folder: Path) -> list[Path]:
    made = read_result(folder)
    if made.command != "recipe":
        return [folder]
    parts = [folder / PARTS / part.name for part in getattr(made, "parts", ()) if part.command == "sweep"]
    if not parts:
        raise InputError(f"explain: expected sweeps, got {folder}, a recipe without one")
    return parts
