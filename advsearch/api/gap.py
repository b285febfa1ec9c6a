"""Questions that take several attacks: robust accuracy against epsilon, and the worst case beside the average."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.api.attack import LOADING, attack_once, check_from_config, executor_for, problem_from_config
from advsearch.api.keywords import GapKeywords, asks, configured
from advsearch.api.parts import SETTLED, StudyAttack, chains_of, share
from advsearch.attacks import clopper_pearson
from advsearch.attacks.verification import WORST_CASE
from advsearch.cluster.executor import Call
from advsearch.config import AttackConfig, GapConfig
from advsearch.engine.answers import one_label_for_several
from advsearch.engine.loading import Scene
from advsearch.engine.naming import AnyModel, different, load_models
from advsearch.engine.sharing import answering
from advsearch.engine.transfer import Transfer
from advsearch.engine.transport import CleanMatrix
from advsearch.files import JsonObject
from advsearch.interrupts import interruptible
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.report.drawing import Figures
from advsearch.report.studies import curve_figure, gap_figure, matrix_figure
from advsearch.report.tables import CurveTable, GapTable
from advsearch.runs.answer import read_answer
from advsearch.runs.directory import CONFIG, PARTS, RunDirectory, is_run
from advsearch.runs.files import write_bytes
from advsearch.runs.listing import finished
from advsearch.runs.results.attack import AttackSummary, AverageCase
from advsearch.runs.results.base import INTERRUPTED
from advsearch.runs.results.gap import CurvePoint, GapRow, ObjectRow, StudyResult
from advsearch.runs.results.matrix import MatrixCell, MatrixModel, MatrixResult, MatrixRow
from advsearch.runs.summary import attack_of
from advsearch.scene.library import list_objects, load_object
from advsearch.tasks import make_task
from advsearch.viewer.pages import write_page

if TYPE_CHECKING:
    from typing_extensions import Unpack


@asks(GapConfig, GapKeywords)
def gap(
    object: Scene | str | Path,
    model: AnyModel = "reference",
    *,
    progress: Watched = None,
    **settings: Unpack[GapKeywords],
) -> GapTable:
    """Compare the worst configuration with the average, for each object and each control (docs/questions.md).

    All other arguments are the settings of `advsearch gap`. The run is kept, in `run` or under runs/.

    Args:
        object: from `load_scene`, or names of objects, or files of them, separated by commas.
        model: from `load_model`, or what that takes.
        progress: True shows a bar, False none, None one on a terminal; or told how far it is.

    Raises:
        InputError: anything that the caller can put right; nothing is written then.
    """
    config = configured(GapConfig, object=object, model=model, **settings)
    return gap_from_config(config, progress=watcher(progress))


def curve_from_config(
    config: AttackConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> CurveTable:
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

    def result(rows: list[ObjectRow], common: StudyResult) -> CurveTable:
        curve = [_accuracy(rows, epsilon) for epsilon in epsilons]
        return CurveTable(**vars(common), epsilons=list(epsilons), table=rows, curve=curve)

    return _study(
        config,
        _curve,
        result,
        curve_figure,
        progress=progress or NullProgress(),
        resumed=resumed,
    )


def gap_from_config(config: GapConfig, *, progress: Progress | None = None, resumed: Path | None = None) -> GapTable:
    """The worst case beside the average, over the same space and budget, for each object and each control."""

    def result(rows: list[GapRow], common: StudyResult) -> GapTable:
        return GapTable(**vars(common), table=rows)

    return _study(
        config,
        _gap,
        result,
        gap_figure,
        progress=progress or NullProgress(),
        resumed=resumed,
    )


def matrix_from_config(
    config: AttackConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> MatrixResult:
    """Attack several models, and try every answer on each of them in pictures that are the same for all.

    Trial k has the same seed for every answer and every model, and none that a search or its verification has used.
    Models of one input size are shown the same picture; for another size the same configuration is rendered anew. A
    success needs the model to be right on the clean scene with the same seed, as everywhere.

    Args:
        config: with several models.
        progress: told how far it is.
        resumed: folder of the run to go on with.

    Raises:
        InputError: anything that the caller can put right, such as a model that has no class for the label.
    """
    names, progress = different(config.models, "model"), progress or NullProgress()
    progress.stage(LOADING)
    for name in names:
        check_from_config(_alone(config, name))

    def result(rows: tuple[list[MatrixModel], list[MatrixRow]], common: StudyResult) -> MatrixResult:
        return MatrixResult(**vars(common), models=list(names), ensemble=config.ensemble, tested=rows[0], table=rows[1])

    return _study(
        config,
        lambda parts: _matrix(config, names, parts),
        result,
        matrix_figure,
        progress=progress,
        resumed=resumed,
    )


# ---- one study ------------------------------------------------------------------------------------------------------


Study = TypeVar("Study", bound=StudyResult)
Rows = TypeVar("Rows")


def _study(
    config: AttackConfig,
    attacks: Callable[[_Parts], Rows],
    result_of: Callable[[Rows, StudyResult], Study],
    figure_of: Callable[[Study], Figures],
    *,
    progress: Progress,
    resumed: Path | None,
) -> Study:
    """Carry out the attacks of a study in its run.

    Args:
        config: what is asked.
        attacks: carries out the attacks and returns their rows.
        result_of: puts these into a result, beside what all studies have in common.
        figure_of: draws the result.
        progress: told how far it is.
        resumed: folder of the run to go on with.
    """
    begun = time.perf_counter()
    with RunDirectory.of(config, resumed) as run:
        notes = _label_for_all(config)
        for text in notes:
            progress.message(text)
        parts = _Parts(config, run, progress)
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
        for suffix, data in figure_of(result).items():
            write_bytes(run.path / "images" / f"{config.command}.{suffix}", data)
        run.write_summary(result)
        write_page(run.path, result)
        return result


def _label_for_all(config: AttackConfig) -> list[str]:
    """What there is to say where several bundled objects have one label."""
    if config.label is None or len(config.objects) < 2:
        return []
    bundled = list_objects()
    own = {name: load_object(name).label if name in bundled else None for name in config.objects}
    models, _ = load_models([config.model], make_task(config.task), config)
    return one_label_for_several(models, config.label, own)


class _Parts:
    """Carries out attacks, each in a folder of its own, unless they are done already; first on workers, if asked to.

    Attributes:
        chains: all that there are.
        run: of the study.
        progress: told how far it is.
        names: of the parts so far.
        warnings: what they said, each sentence once.
        interrupted: whether one was; nothing more is carried out then.
    """

    def __init__(self, config: AttackConfig, run: RunDirectory, progress: Progress) -> None:
        self.chains, self.run, self.progress = chains_of(config), run, progress
        self.names: list[str] = []
        self.warnings: list[str] = []
        self.interrupted = False
        try:
            with interruptible():
                share(config, self.chains, run.path, progress)
        except KeyboardInterrupt:
            self.interrupted = True

    def attack(self, one: StudyAttack, clean: CleanMatrix | None = None) -> AttackSummary | None:
        """Return the summary of one attack, or None if there was an interrupt; `clean` as for `attack_once`."""
        if self.interrupted:
            return None
        config, path = one.config, self.run.path / PARTS / one.name
        self.names.append(one.name)
        budget = f", epsilon {config.epsilon:.3g}" if isinstance(config.epsilon, float) else ""
        what = f"{config.object} against {config.model}, {' and '.join(config.controls)}{budget}"
        self.progress.message(f"attack {len(self.names)} of at most {sum(map(len, self.chains))}: {what}")
        if is_run(path) and (path / CONFIG).is_file():
            began = None if finished(path) else AttackConfig.from_yaml(path / CONFIG)
            summary = (
                attack_once(began, progress=self.progress, resumed=path, clean=clean).summary
                if began
                else attack_of(path)
            )
        else:
            own = config.model_copy(update={"run": str(path), "overwrite": True})
            summary = attack_once(own, progress=self.progress, clean=clean).summary
        self.warnings += [text for text in summary.warnings if text not in self.warnings]
        self.interrupted = summary.ending == INTERRUPTED
        return None if self.interrupted else summary


# ---- robust accuracy against epsilon --------------------------------------------------------------------------------


def _curve(parts: _Parts) -> list[ObjectRow]:
    rows = []
    for chain in parts.chains:
        row, clean = ObjectRow(object=chain[0].of, clean=None, flips_at=None), CleanMatrix()
        renders: Counter[str] = Counter()
        for one in chain:
            summary = parts.attack(one, clean)
            if summary is None:
                break
            renders.update(summary.renders)
            row = _seen(one.of, summary, one.epsilon).model_copy(update={"renders": dict(renders)})
            if row.ending in SETTLED:
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
    if row.ending in SETTLED:
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


def _gap(parts: _Parts) -> list[GapRow]:
    rows = []
    for (one,) in parts.chains:
        summary = parts.attack(one)
        if summary is not None and summary.average is not None:
            rows.append(_compared(one.config.object, one.of, summary, summary.average))
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


# ---- attacked on against tested on -----------------------------------------------------------------------------------

LEAST_SPP = 64
"""Samples a pixel of the trials, where none of the attacks needed more and nothing was asked for."""


def _matrix(config: AttackConfig, names: Sequence[str], parts: _Parts) -> tuple[list[MatrixModel], list[MatrixRow]]:
    """Attack, then try every answer on every model."""
    attacked: list[tuple[str, AttackSummary]] = []
    for (one,) in parts.chains:
        summary = parts.attack(one)
        if summary is not None:
            attacked.append((one.of, summary))
    models: list[MatrixModel] = []
    cells: dict[str, list[MatrixCell]] = {}
    answers = {name: u for name, summary in attacked if (u := _answer(summary)) is not None}
    if answers and not parts.interrupted:
        spp = config.verify_spp or max([LEAST_SPP, *(s.sample_count.spp for _, s in attacked if s.sample_count)])
        try:
            with interruptible():
                parts.progress.stage("loading the models to try the answers on")
                problems = {name: problem_from_config(_alone(config, name))[0] for name in names}
                seed, trials = seeds.stream(config.seed, "matrix"), config.trial_count
                with executor_for(config, "advsearch.api.gap:models_answering", parts.progress) as executor:
                    kept = (problems, parts.run, parts.progress, executor)
                    tried = Transfer(*kept, trials=trials, spp=spp, seed=seed)
                    models = tried.clean()
                    for name, u in answers.items():
                        cells[name] = tried.on_each(name, u)
        except KeyboardInterrupt:
            parts.interrupted = True
    rows = [
        MatrixRow(attacked=name, ending=one.ending, run=one.run, renders=one.renders, tested=cells.get(name, []))
        for name, one in attacked
    ]
    return models, rows


def models_answering(settings: JsonObject) -> Call:
    """Return what answers queries of the models of a configuration: what a worker does."""
    config = AttackConfig(**settings)
    return answering(cache(lambda name: problem_from_config(_alone(config, name))[0]))


def _alone(config: AttackConfig, name: str) -> AttackConfig:
    """What an answer is tried on one model with; nothing is searched."""
    return AttackConfig.of(config, model=name, ensemble=None)


def _answer(summary: AttackSummary) -> Tensor | None:
    """The configuration that an attack answers with; None where nothing was searched."""
    if summary.adversarial is None or summary.run is None:
        return None
    return torch.from_numpy(read_answer(Path(summary.run)))
