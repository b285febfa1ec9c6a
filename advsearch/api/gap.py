"""Questions that take several attacks: robust accuracy against epsilon, and the worst case beside the average.

Each attack is a run of its own in the folder `parts` of the study's run, so that a study that was stopped goes on with
the part at which it was stopped.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from advsearch.api.attack import attack_once
from advsearch.api.keywords import GapKeywords, asks, configured
from advsearch.attacks import clopper_pearson
from advsearch.attacks.verification import WORST_CASE
from advsearch.config import AttackConfig, GapConfig
from advsearch.engine.answers import one_label_for_several
from advsearch.engine.naming import different, load_models
from advsearch.engine.run_settings import RunSettings
from advsearch.progress import NullProgress, Progress
from advsearch.report.studies import curve_figure, gap_figure
from advsearch.runs.directory import CONFIG, PARTS, RunDirectory, default_name, is_run
from advsearch.runs.files import write_bytes
from advsearch.runs.listing import finished
from advsearch.runs.results.attack import AttackSummary, AverageCase
from advsearch.runs.results.base import INTERRUPTED
from advsearch.runs.results.gap import CurvePoint, CurveResult, GapResult, GapRow, ObjectRow, StudyResult
from advsearch.runs.summary import attack_of
from advsearch.scene.library import list_objects, load_object
from advsearch.tasks import make_task

if TYPE_CHECKING:
    from typing_extensions import Unpack


@asks(GapConfig, GapKeywords)
def gap(
    object: str | Path,
    model: str | Path = "reference",
    *,
    progress: Progress | None = None,
    **settings: Unpack[GapKeywords],
) -> GapResult:
    """Compare the worst configuration with the average, for each object and each control (docs/questions.md).

    All other arguments are the settings of `advsearch gap`. The run is kept, in `run` or under runs/.

    Args:
        object: names of objects, or files of them, separated by commas.
        model: the network under test, as `advsearch gap` takes it.
        progress: told how far it is.

    Raises:
        InputError: anything that the caller can put right; nothing is written then.
    """
    config = configured(GapConfig, object=object, model=model, **settings)
    return gap_from_config(config, progress=progress)


def curve_from_config(
    config: AttackConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> CurveResult:
    """Robust accuracy against epsilon, over objects.

    The epsilons are tried from the smallest. An object that flips at one of them flips at every larger one, whose ball
    has the same configuration in it, so it is not attacked again. An object that is wrong as it is counts as not robust
    at any epsilon, and is told apart from those that were found.

    Args:
        config: with one or several objects and epsilons.
        progress: told how far it is.
        resumed: folder of the run to go on with.
    """

    epsilons: Sequence[float | None] = sorted(config.epsilons) or [None]

    def result(rows: list[ObjectRow], common: StudyResult) -> CurveResult:
        curve = [_accuracy(rows, epsilon) for epsilon in epsilons]
        return CurveResult(**vars(common), epsilons=list(epsilons), table=rows, curve=curve)

    return _study(config, lambda parts: _curve(config, epsilons, parts), result, progress or NullProgress(), resumed)


def gap_from_config(config: GapConfig, *, progress: Progress | None = None, resumed: Path | None = None) -> GapResult:
    """The worst case beside the average, over the same space and budget, for each object and each control."""

    def result(rows: list[GapRow], common: StudyResult) -> GapResult:
        return GapResult(**vars(common), table=rows)

    return _study(config, lambda parts: _gap(config, parts), result, progress or NullProgress(), resumed)


# ---- one study ------------------------------------------------------------------------------------------------------


Study = TypeVar("Study", bound=CurveResult | GapResult)
Rows = TypeVar("Rows")


def _study(
    config: AttackConfig,
    attacks: Callable[[_Parts], Rows],
    result_of: Callable[[Rows, StudyResult], Study],
    progress: Progress,
    resumed: Path | None,
) -> Study:
    """Carry out the attacks of a study in its run; `attacks` returns their rows, `result_of` puts these into a result
    beside what all studies have in common."""
    begun = time.perf_counter()
    with RunDirectory.of(config, resumed) as run:
        notes = _label_for_all(config)
        for text in notes:
            progress.message(text)
        each = len(config.controls) if isinstance(config, GapConfig) else max(1, len(config.epsilons))
        parts = _Parts(run.path / PARTS, progress, len(config.objects) * each)
        rows = attacks(parts)
        common = StudyResult(
            run=str(run.path),
            objects=list(config.objects),
            controls=list(config.controls),
            environment=config.lit_by,
            model=config.model,
            task=config.task_name,
            policy=config.policy_name,
            warnings=[*notes, *parts.warnings],
            parts=parts.names,
            ending=INTERRUPTED if parts.interrupted else "done",
            seconds={"total": time.perf_counter() - begun},
            seed=config.seed,
            command_line=config.command_line(),
        )
        result = result_of(rows, common)
        figure = gap_figure(result) if isinstance(result, GapResult) else curve_figure(result)
        for suffix, data in figure.items():
            write_bytes(run.path / "images" / f"{config.command}.{suffix}", data)
        run.write_summary(result)
        return result


def _label_for_all(config: AttackConfig) -> list[str]:
    """What there is to say where several bundled objects have one label."""
    if config.label is None or len(config.objects) < 2:
        return []
    bundled = list_objects()
    own = {name: load_object(name).label if name in bundled else None for name in config.objects}
    models, _ = load_models(
        [config.model], make_task(config.task), labels=config.labels, used_threads=config.used_threads
    )
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

    def attack(self, config: AttackConfig, name: str) -> AttackSummary | None:
        """Return the summary of one attack, or None if there was an interrupt."""
        if self.interrupted:
            return None
        path = self._folder / name
        self.names.append(name)
        budget = f", epsilon {config.epsilon:.3g}" if isinstance(config.epsilon, float) else ""
        what = f"{config.object}, {' and '.join(config.controls)}{budget}"
        self._progress.message(f"attack {len(self.names)} of at most {self._most}: {what}")
        if is_run(path) and (path / CONFIG).is_file():
            began = None if finished(path) else AttackConfig.from_yaml(path / CONFIG)
            summary = attack_once(began, progress=self._progress, resumed=path).summary if began else attack_of(path)
        else:
            own = config.model_copy(update={"run": str(path), "overwrite": True})
            summary = attack_once(own, progress=self._progress).summary
        self.warnings += [text for text in summary.warnings if text not in self.warnings]
        self.interrupted = summary.ending == INTERRUPTED
        return None if self.interrupted else summary


# ---- robust accuracy against epsilon --------------------------------------------------------------------------------


def _curve(config: AttackConfig, epsilons: Sequence[float | None], parts: _Parts) -> list[ObjectRow]:
    rows = []
    for place, name in enumerate(different(config.objects, "object")):
        row = ObjectRow(object=name, clean=None, flips_at=None)
        for epsilon in epsilons:
            label = f"{place:02d}-" + default_name(
                name, [] if epsilon is None else [f"epsilon {epsilon:g}".replace(".", "_")]
            )
            one = AttackConfig.of(config, object=name, epsilon=config.epsilon if epsilon is None else epsilon)
            summary = parts.attack(one, label)
            if summary is None:
                break
            row = _seen(name, summary, epsilon)
            if row.ending in ("found", "already wrong"):
                break
        rows.append(row)
    return rows


def _seen(name: str, summary: AttackSummary, tried: float | None) -> ObjectRow:
    epsilon = summary.epsilon if tried is None else tried
    return ObjectRow(
        object=name,
        clean=summary.clean.control,
        ending=summary.ending,
        epsilon=epsilon,
        flips_at=epsilon if summary.ending == "found" else None,
        verified=summary.verified,
        margin=summary.verified.margin if summary.verified else None,
        run=summary.run,
        tried=tried,
    )


def _known(row: ObjectRow, epsilon: float | None) -> bool:
    """Whether a row says anything about an epsilon: it was tried there, or had flipped before.

    What ended without a number says nothing, and neither does an object that its own noise makes wrong too often for
    any answer to be verified.
    """
    if row.ending in (None, "non-finite objective"):
        return False
    if row.ending in ("found", "already wrong"):
        return True
    steady = row.clean is not None and row.clean.correct >= WORST_CASE.needed(row.clean.trials)
    return steady and (epsilon is None or (row.tried is not None and row.tried >= epsilon))


def _accuracy(rows: Sequence[ObjectRow], epsilon: float | None) -> CurvePoint:
    """How many objects are still recognised at an epsilon."""
    known = [row for row in rows if _known(row, epsilon)]
    wrong = sum(row.ending == "already wrong" for row in known)
    found = sum(row.ending == "found" and _flips_within(row, epsilon) for row in known)
    robust = len(known) - wrong - found
    return CurvePoint(
        epsilon=epsilon,
        objects=len(known),
        robust=robust,
        found=found,
        already_wrong=wrong,
        accuracy=robust / len(known) if known else None,
        interval=clopper_pearson(robust, len(known)) if known else (0.0, 1.0),
    )


def _flips_within(row: ObjectRow, epsilon: float | None) -> bool:
    return epsilon is None or (isinstance(row.flips_at, float) and row.flips_at <= epsilon)


# ---- worst case beside the average ----------------------------------------------------------------------------------


def _gap(config: GapConfig, parts: _Parts) -> list[GapRow]:
    shared = RunSettings(config.epsilon, config.norm, config.texture_resolution)
    shared.check(config.controls, config.over)
    rows = []
    for place, name in enumerate(different(config.objects, "object")):
        for number, (control, settings) in enumerate(config.controls.items()):
            own = vars(shared.alone(control, settings))
            one = AttackConfig.of(config, object=name, controls={control: settings}, **own)
            summary = parts.attack(one, f"{place:02d}-{number:02d}-" + default_name(name, [control]))
            if summary is not None and summary.average is not None:
                rows.append(_compared(name, control, summary, summary.average))
    return rows


def _compared(name: str, control: str, summary: AttackSummary, average: AverageCase) -> GapRow:
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
