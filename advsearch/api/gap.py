"""Questions that take several attacks: robust accuracy against epsilon, and the worst case beside the average.

Each attack is a run of its own in the folder `parts` of the study's run, so that a study that was stopped goes on with
the part at which it was stopped.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from advsearch.api.attack import attack_from_config, resume_attack
from advsearch.attacks import clopper_pearson
from advsearch.attacks.verification import WORST_CASE
from advsearch.config import AttackConfig, GapConfig
from advsearch.engine.answers import one_label_for_several
from advsearch.engine.naming import check_run_settings, different, load_models, run_settings_for
from advsearch.progress import NullProgress, Progress
from advsearch.report.studies import curve_figure, gap_figure
from advsearch.runs.directory import CONFIG, PARTS, RunDirectory, default_name, is_run
from advsearch.runs.files import write_bytes
from advsearch.runs.listing import finished
from advsearch.runs.summary import read_summary
from advsearch.scene.library import list_objects, load_object

Summary = dict[str, Any]


def curve_from_config(
    config: AttackConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> Summary:
    """Robust accuracy against epsilon, over objects.

    The epsilons are tried from the smallest. An object that flips at one of them flips at every larger one, whose ball
    has the same configuration in it, so it is not attacked again. An object that is wrong as it is counts as not robust
    at any epsilon, and is told apart from those that were found.

    Args:
        config: with one or several objects and epsilons.
        progress: told how far it is.
        resumed: folder of the run to go on with.

    Returns:
        What `summary.json` holds: `curve` with the accuracy and its 95 % interval (Clopper-Pearson, over objects) at
        each epsilon, and one row of `table` for each object.
    """
    return _study(config, _curve, progress or NullProgress(), resumed)


def gap_from_config(config: GapConfig, *, progress: Progress | None = None, resumed: Path | None = None) -> Summary:
    """The worst case beside the average, over the same space and budget, for each object and each control.

    Returns:
        What `summary.json` holds: one row of `table` for each object and control, with the accuracy over random
        configurations, its interval, and the verified rate and margin of the worst configuration.
    """
    return _study(config, _gap, progress or NullProgress(), resumed)


# ---- one study ------------------------------------------------------------------------------------------------------


def _study(config: Any, body: Callable[[Any, _Parts], Summary], progress: Progress, resumed: Path | None) -> Summary:
    begun = time.perf_counter()
    opened = RunDirectory.resume(resumed, config) if resumed is not None else RunDirectory.create_for(config)
    with opened as run:
        said = _label_for_all(config)
        for text in said:
            progress.message(text)
        each = len(config.controls) if isinstance(config, GapConfig) else max(1, len(config.epsilons))
        parts = _Parts(run.path / PARTS, progress, len(config.objects) * each)
        answer = {
            "schema": 1,
            "command": config.command,
            "run": str(run.path),
            "objects": list(config.objects),
            "controls": list(config.controls),
            "environment": config.lit_by,
            "model": config.model,
            "task": config.task,
            "policy": config.policy_name,
            **body(config, parts),
            "warnings": [*said, *parts.warnings],
            "parts": parts.names,
            "ending": "interrupted" if parts.interrupted else "done",
            "seconds": {"total": time.perf_counter() - begun},
            "seed": config.seed,
            "command_line": config.command_line(),
        }
        figure = gap_figure(answer) if isinstance(config, GapConfig) else curve_figure(answer)
        for suffix, data in figure.items():
            write_bytes(run.path / "images" / f"{config.command}.{suffix}", data)
        run.write_summary(answer)
        return answer


def _label_for_all(config: AttackConfig) -> list[str]:
    """What there is to say where several bundled objects have one label."""
    if config.label is None or len(config.objects) < 2:
        return []
    bundled = list_objects()
    own = {name: load_object(name).label if name in bundled else None for name in config.objects}
    models, _ = load_models([config.model], config)
    return one_label_for_several(models, config.label, own)


class _Parts:
    """Carries out attacks, each in a folder of its own, unless they are done already.

    Attributes:
        names: of the parts so far.
        warnings: what they said, each sentence once.
        interrupted: whether one was; nothing more is carried out then.
    """

    def __init__(self, folder: Path, progress: Progress, most: int) -> None:
        self.names: list[str] = []
        self.warnings: list[str] = []
        self.interrupted = False
        self._folder, self._progress, self._most = folder, progress, most

    def attack(self, config: AttackConfig, name: str) -> Summary | None:
        """Return the summary of one attack, or None if there was an interrupt."""
        if self.interrupted:
            return None
        path = self._folder / name
        self.names.append(name)
        budget = f", epsilon {config.epsilon:.3g}" if isinstance(config.epsilon, float) else ""
        what = f"{config.object}, {' and '.join(config.controls)}{budget}"
        self._progress.message(f"attack {len(self.names)} of at most {self._most}: {what}")
        if is_run(path) and (path / CONFIG).is_file():
            summary = read_summary(path) if finished(path) else resume_attack(path, progress=self._progress).summary
        else:
            own = config.model_copy(update={"run": str(path), "overwrite": True})
            summary = attack_from_config(own, progress=self._progress).summary
        self.warnings += [text for text in summary.get("warnings") or () if text not in self.warnings]
        self.interrupted = summary["ending"] == "interrupted"
        return None if self.interrupted else summary


def _as_attack(config: AttackConfig, **update: Any) -> AttackConfig:
    """One attack of a study."""
    fields = {name: getattr(config, name) for name in AttackConfig.model_fields}
    return AttackConfig.model_construct(**{**fields, **update})


# ---- robust accuracy against epsilon --------------------------------------------------------------------------------


def _curve(config: AttackConfig, parts: _Parts) -> Summary:
    epsilons: Sequence[float | None] = sorted(config.epsilons) or [None]
    rows = []
    for place, name in enumerate(different(config.objects, "object")):
        row: Summary = {"object": name, "clean": None, "flips_at": None}
        for epsilon in epsilons:
            label = f"{place:02d}-" + default_name(
                name, [] if epsilon is None else [f"epsilon {epsilon:g}".replace(".", "_")]
            )
            one = _as_attack(config, object=name, epsilon=config.epsilon if epsilon is None else epsilon)
            summary = parts.attack(one, label)
            if summary is None:
                break
            row |= _seen(summary, epsilon) | {"tried": epsilon}
            if row["ending"] in ("found", "already wrong"):
                break
        rows.append(row)
    return {"epsilons": list(epsilons), "table": rows, "curve": [_accuracy(rows, epsilon) for epsilon in epsilons]}


def _seen(summary: Mapping[str, Any], epsilon: float | None) -> Summary:
    verified = summary.get("verified") or {}
    return {
        "clean": summary["clean"]["control"],
        "ending": summary["ending"],
        "epsilon": summary.get("epsilon") if epsilon is None else epsilon,
        "flips_at": (epsilon if epsilon is not None else summary.get("epsilon"))
        if summary["ending"] == "found"
        else None,
        "verified": verified,
        "margin": verified.get("margin"),
        "run": summary["run"],
    }


def _known(row: Summary, epsilon: float | None) -> bool:
    """Whether a row says anything about an epsilon: it was tried there, or had flipped before.

    What ended without a number says nothing, and neither does an object that its own noise makes wrong too often for
    any answer to be verified.
    """
    ending = row.get("ending")
    if ending in (None, "non-finite objective"):
        return False
    if ending in ("found", "already wrong"):
        return True
    clean = row["clean"]
    steady = clean is not None and clean["correct"] >= WORST_CASE.needed(clean["trials"])
    return steady and (epsilon is None or row["tried"] >= epsilon)


def _accuracy(rows: Sequence[Summary], epsilon: float | None) -> Summary:
    """How many objects are still recognised at an epsilon."""
    known = [row for row in rows if _known(row, epsilon)]
    wrong = sum(row["ending"] == "already wrong" for row in known)
    found = sum(row["ending"] == "found" and (epsilon is None or float(row["flips_at"]) <= epsilon) for row in known)
    robust = len(known) - wrong - found
    low, high = clopper_pearson(robust, len(known)) if known else (0.0, 1.0)
    return {
        "epsilon": epsilon,
        "objects": len(known),
        "robust": robust,
        "found": found,
        "already_wrong": wrong,
        "accuracy": robust / len(known) if known else None,
        "interval": [low, high],
    }


# ---- worst case beside the average ----------------------------------------------------------------------------------


def _gap(config: GapConfig, parts: _Parts) -> Summary:
    check_run_settings(config)
    rows = []
    for place, name in enumerate(different(config.objects, "object")):
        for number, (control, settings) in enumerate(config.controls.items()):
            shared = run_settings_for(config, control, settings)
            one = _as_attack(config, object=name, controls={control: settings}, **shared)
            summary = parts.attack(one, f"{place:02d}-{number:02d}-" + default_name(name, [control]))
            if summary is not None:
                rows.append(_compared(name, control, summary))
    return {"table": rows}


def _compared(name: str, control: str, summary: Mapping[str, Any]) -> Summary:
    verified = summary.get("verified") or {}
    return {
        "object": name,
        "control": control,
        "average": summary["average"],
        "worst": verified or None,
        "ending": summary["ending"],
        "margin": verified.get("margin"),
        "renders": summary["renders"],
        "run": summary["run"],
    }
