"""Find rules under which a model is wrong, from the rows of sweeps.

Fresh renders confirm the rules.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from advsearch.extend import (
    Config,
    InputError,
    PositionalArgument,
    RunContext,
    RunDirectory,
    SceneConfig,
    directory,
    experiment,
    read_result,
    results,
    setting,
    setting_as_in,
    settings,
)
from advsearch.questions.explain.result import (
    ExplainResult,
    RuleRow,
    list_rule_triggers,
    make_explain_claims,
    make_explain_view,
)

if TYPE_CHECKING:
    import pandas as pd

    from advsearch.extend import workbench


class ExplainConfig(Config):
    """Settings of `explain`: the sweeps that it reads, and how much it renders."""

    command: ClassVar[str] = "explain"
    clashes: ClassVar[tuple[settings.Clash, ...]] = tuple(
        clash for clash in SceneConfig.clashes if clash.setting == "overwrite"
    )

    # fmt: off
    sweeps: str = setting(
        ..., "explain", "sweeps whose rows are read as one table, separated by commas",
        "names or folders of runs of sweep, or of recipes with sweeps",
    )
    confirm: int = setting(
        100, "explain", "number of fresh configurations that are rendered inside each "
                        "rule to confirm it; 0 for none",
        unit="renders", ge=0, le=100_000,
    )
    pairs: int = setting(
        12, "explain", "number of failures for which the nearest right configuration "
                       "is searched; 0 for none",
        unit="failures", ge=0, le=100,
    )
    clusters: int = setting(
        100, "explain", "number of failures that are rendered again and clustered by "
                        "the model's features; 0 for none",
        unit="failures", ge=0, le=10_000,
    )
    # fmt: on
    accuracy: float = setting(
        0.95,
        "explain",
        "minimum accuracy inside the envelope, at 95 % confidence",
        gt=0.0,
        le=0.999,
    )
    seed: int = setting_as_in(SceneConfig, "seed")
    threads: int | None = setting_as_in(SceneConfig, "threads")
    run: str | None = setting_as_in(
        SceneConfig, "run", otherwise="runs/RUN-explain-NNN"
    )
    overwrite: bool = setting_as_in(SceneConfig, "overwrite")

    _named = settings.text_validator("run", several=["sweeps"])
    _different = settings.unique_names_validator("sweeps")

    @property
    def run_name_words(self) -> tuple[str, ...]:
        return Path(settings.split_names(self.sweeps)[0]).name, self.command


@experiment(
    "explain mug-sweep-001",
    "explain mug-sweep-001 mug-sweep-002 --confirm 200 --accuracy 0.9",
    "explain mug-sweep-001 --confirm 0 --pairs 0 --json",
    positional_args=("sweeps",),
    about="sweeps",
    positional=PositionalArgument("RUN", "the run of a sweep", is_repeatable=True),
    view=make_explain_view,
    claims=make_explain_claims,
    triggering=list_rule_triggers,
)
def explain(context: RunContext[ExplainConfig]) -> ExplainResult:
    """Find rules under which a model is wrong, and confirm them (docs/explain.md).

    Args:
        sweeps: name or folder of a run of `sweep` that has ended; or several, whose
            rows are read as one table. For a recipe, all of its sweeps are read.
    """
    # these import torch, scipy and pandas
    from advsearch.questions.explain import findings
    from advsearch.questions.explain.renders import SweepRunner

    context.progress.stage("reading rows")
    sweeps = _read_sweeps(context.config)
    rows, table = read_table(sweeps)
    found_rules, importance, envelope = _analyze_rows(
        table, context.config, context.progress
    )
    renders = SweepRunner(context, sweeps, rows, table)
    rendered_fields = _render_findings(renders, found_rules)
    if renders.interrupted:
        context.ending = results.INTERRUPTED
    return context.result(
        ExplainResult,
        **_join_sweep_names(sweeps),
        **_count_rows(table),
        **rendered_fields,
        rejected_rule=findings.make_rejected_rule(
            found_rules.best_rejected, len(table)
        ),
        importance=importance,
        envelope=envelope,
        warnings=[*renders.warnings, *findings.find_row_warnings(table, importance)],
    )


def _join_sweep_names(sweeps: Sequence[workbench.StoredSweep]) -> dict[str, Any]:
    """Return the fields of the result that name the sweeps and what they rendered."""
    return {
        "sweeps": [str(sweep.folder) for sweep in sweeps],
        "object": settings.join_names(sweep.summary.object for sweep in sweeps),
        "model": settings.join_names(sweep.summary.model for sweep in sweeps),
        "environment": settings.join_names(
            sweep.summary.environment for sweep in sweeps
        ),
        "controls": sweeps[0].summary.controls,
    }


def _count_rows(table: pd.DataFrame) -> dict[str, Any]:
    """Return the fields of the result about all rows: parameters, counts and draws."""
    # heavy, and the help of the command line reads this module
    from advsearch.questions.explain import findings

    return {
        "parameters": list(table.attrs["units"]),
        # the counts of all rows: right, total, interval, share and outcomes
        **vars(findings.count_right(table)),
        # the number of draws, if several rows share a draw; else None
        "units": None if table["unit"].is_unique else table["unit"].nunique(),
    }


def _render_findings(renders: Any, found_rules: Any) -> dict[str, Any]:
    """Render what tests the findings, and return the fields of the result about that.

    Args:
        renders: renders configurations, until it is interrupted.
        found_rules: the rules that were found.
    """
    rule_rows = _confirm_rules(renders, found_rules)
    pairs = list(renders.find_pairs(found_rules.accepted))
    clusters = renders.find_clusters()
    return {
        "rules": rule_rows,
        "pairs": pairs,
        "pairs_sought": renders.pairs_sought,
        "clusters": clusters,
        "renders": renders.n_renders,
    }


def _read_sweeps(config: ExplainConfig) -> list[workbench.StoredSweep]:
    """Read the rows of the sweeps that the settings name."""
    # heavy, and the help of the command line reads this module
    from advsearch.extend import workbench

    return [
        workbench.StoredSweep.read(path)
        for name in settings.split_names(config.sweeps)
        for path in find_sweeps(directory.find_run(name))
    ]


def _analyze_rows(
    table: Any, config: ExplainConfig, progress: Any
) -> tuple[Any, Any, Any]:
    """Find rules, the importance of parameters, and where predictions are right.

    One half of the rows chooses rules and the box of right predictions; the other half
    tests them.

    Args:
        table: the rows, with a column for each parameter that varies.
        config: the settings.
        progress: the progress bar.

    Returns:
        The rules, the weights of the parameters, and the box (`find_envelope`).
    """
    # heavy, and the help of the command line reads this module
    from advsearch.extend import rules
    from advsearch.questions.explain.envelope import find_envelope
    from advsearch.questions.explain.importance import find_importance

    choosing, counting = rules.split_in_halves(table, config.seed)
    progress.stage("seeking rules on one half of the rows")
    found_rules = rules.find_rules(choosing, counting, config.seed)
    progress.stage("measuring which parameters matter")
    importance = find_importance(table)
    envelope = find_envelope(choosing, counting, config.accuracy)
    return found_rules, importance, envelope


def _confirm_rules(renders: Any, found_rules: Any) -> list[RuleRow]:
    """Render configurations inside each rule, and describe the rules."""
    # heavy, and the help of the command line reads this module
    from advsearch.questions.explain import findings

    return [
        RuleRow(
            **findings.describe_rule(rule),
            confirmed=renders.confirm_rule(found_rules.accepted, index),
        )
        for index, rule in enumerate(found_rules.accepted)
    ]


def read_table(
    sweeps: Sequence[workbench.StoredSweep],
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the rows of sweeps in which the object is in view, as two frames.

    Returns:
        The rows with all columns; and a table of the parameters that vary in all of
        them. Its `attrs["units"]` maps the names of these parameters to their units.

    Raises:
        InputError: there are too few rows, or no parameter varies in all of them.
    """
    from advsearch.extend import rules  # imports pandas
    from advsearch.questions.explain.rows import read_predictions

    rows = read_predictions(sweeps)
    rows = rows[rules.is_in_view(rows)].reset_index(drop=True)
    _check_row_count(rows, rules.MIN_ROWS)
    table = rules.make_table(rows, rows.attrs["units"])
    if not table.attrs["units"]:
        raise InputError(
            "explain: expected a parameter that varies and that all rows have, got none"
        )
    return rows, table


def _check_row_count(rows: pd.DataFrame, n_needed: int) -> None:
    """Check that there are enough rows.

    Raises:
        InputError: there are fewer.
    """
    if len(rows) < n_needed:
        raise InputError(
            f"explain: expected at least {n_needed} rows, got {len(rows)}; sweep "
            "more configurations"
        )


def find_sweeps(path: Path) -> list[Path]:
    """Return the directories of the sweeps of a run.

    For a recipe, they are those of its parts. For a sweep, it is that of the run
    itself.
    """
    result = read_result(path)
    if result.command != "recipe":
        return [path]
    parts = [part for part in getattr(result, "parts", ()) if part.command == "sweep"]
    if not parts:
        raise InputError(f"explain: expected sweeps, got {path}, a recipe without one")
    return [RunDirectory.locate_part(path, part.name) for part in parts]
