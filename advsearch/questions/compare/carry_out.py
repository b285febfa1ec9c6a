"""`compare`: read the sides from stored sweeps, or sweep first; count pairs; show what one side alone gets right."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from typing_extensions import Unpack

from advsearch.api.keywords import Named, Names, SampledKeywords, asks, configured
from advsearch.api.studies import carry_out_part
from advsearch.engine.loading import Controls
from advsearch.engine.sweeps.swept_scene import Scenes
from advsearch.errors import InputError, ModelError
from advsearch.interrupts import interruptible
from advsearch.progress import NullProgress, Progress, Watched, watcher
from advsearch.questions.compare.answer import ComparedPair, ComparedSide, CompareResult, PairPicture
from advsearch.questions.compare.pairs import Side, compared, differing, far_apart, read_sides
from advsearch.questions.compare.settings import CompareConfig
from advsearch.questions.sweep.carry_out import scenes_of
from advsearch.rules import interval_of
from advsearch.runs.directory import PARTS, RunDirectory, find_run
from advsearch.runs.files import write_bytes
from advsearch.runs.results.base import INTERRUPTED
from advsearch.settings import split_names
from advsearch.viewer import thumbnails
from advsearch.viewer.pages import keep_answer

SWEEP = "sweep"
"""The part that holds the sweep of models."""


class CompareKeywords(SampledKeywords, total=False):
    object: Names
    task: Named
    grid: dict[str, object]
    controls: Controls
    samples: int | None
    pictures: int
    run: str | Path | None


@asks(CompareConfig, CompareKeywords)
def compare(
    compared: str | Path | Sequence[str | Path], *, progress: Watched = None, **settings: Unpack[CompareKeywords]
) -> CompareResult:
    """Compare models, objects or answers on the same pictures, pair by pair (docs/compare.md).

    All other arguments are the settings of `advsearch compare`. The run is kept, in `run` or under runs/. Models that
    exist in Python alone are swept first (`sweep(scene, [one, other], run=...)`), and then the run is compared.

    Args:
        compared: names or folders of runs of `sweep`: one of several models, or several of the same draws. With
            `object`, names of models, which are shown it first.
    """
    return compare_from_config(configured(CompareConfig, compared=compared, **settings), progress=watcher(progress))


def compare_from_config(
    config: CompareConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> CompareResult:
    """Compare what a configuration describes.

    Raises:
        InputError: sweeps are of other draws, or there is nothing to compare.
        FileFormatError: a run is not a finished sweep.
    """
    begun, progress = time.perf_counter(), progress or NullProgress()
    stored: list[Side] = []
    if not config.object:
        progress.stage("reading rows")
        stored = read_sides([find_run(name) for name in split_names(config.compared)])
    with RunDirectory.of(config, resumed) as run:
        sides, swept = stored, 0
        if config.object:
            part = run.path / PARTS / SWEEP
            done = carry_out_part(part, config.sweep().with_only_here(config.only_here), progress)
            swept = sum(getattr(done, "renders", {}).values())
            sides = [] if done.goes_on else read_sides([part])
        pictures, pairs, warnings = _Pictures(run.path, progress), list[ComparedPair](), _cautions(sides)
        for number, other in enumerate(sides[1:], start=1):
            progress.stage("counting pairs")
            try:
                pair = compared(sides[0], other, config.seed)
            except InputError as error:  # the library that finds rules is missing
                warnings.append(f"Where one side is worse was not looked for: {error}")
                pair = compared(sides[0], other, config.seed, rules=False)
            shown = list(pictures.of(sides[0], other, config.pictures, number))
            pairs.append(pair.model_copy(update={"shown": shown}))
        first = sides[0] if sides else None
        result = CompareResult(
            run=str(run.path),
            environment=_together([one.summary.environment for one in sides]) or config.lit_by,
            controls=first.summary.controls if first else list(config.controls),
            object=_together([one.named["object"] for one in sides]) or config.object,
            model=_together([one.named["model"] for one in sides]) or config.compared,
            task=first.summary.task if first else config.task_name,
            differ=differing(sides) if sides else [],
            sides=[_side(one) for one in sides],
            pairs=pairs,
            renders=swept + pictures.rendered,
            ending=INTERRUPTED if pictures.interrupted or not sides else "done",
            warnings=list(dict.fromkeys([*warnings, *pictures.warnings])),
            seconds={"total": time.perf_counter() - begun},
            seed=config.seed,
            command_line=config.command_line(),
        )
        return keep_answer(run, result)


def _side(side: Side) -> ComparedSide:
    right, total = int(side.right.sum()), len(side.rows)
    return ComparedSide(
        name=side.name,
        run=str(side.folder),
        **side.named,
        configurations=total,
        correct=right,
        accuracy=right / total,
        interval=interval_of(side.rows),
        seconds=float(side.rows["seconds"].mean()),
    )


def _together(names: Sequence[str]) -> str:
    return ",".join(dict.fromkeys(one for name in names for one in split_names(name)))


def _cautions(sides: Sequence[Side]) -> list[str]:
    """What a reader has to know of the sweeps."""
    if not sides:
        return []
    found = [text for side in sides for text in side.summary.warnings]
    names = differing(sides)
    if len(names) > 1:
        listed = f"{', '.join(names[:-1])} and {names[-1]}"
        found.append(f"The sweeps differ in {listed}: what is told here is of all of that together.")
    if not names:
        found.append("The sweeps have the same settings: what differs is in files, in versions, or in the machine.")
    tasks = {side.summary.task for side in sides}
    if len(tasks) > 1:
        found.append(f"What counts as right is judged by different tasks: {', '.join(sorted(tasks))}.")
    return found


@dataclass
class _Pictures:
    """Small pictures of pairs in the folder of the run: those that sweeps kept, or rendered again."""

    folder: Path
    progress: Progress
    rendered: int = 0
    interrupted: bool = False
    warnings: list[str] = field(default_factory=list)
    scenes: dict[Path, Scenes | None] = field(default_factory=dict)

    def of(self, first: Side, second: Side, most: int, pair: int) -> Iterator[PairPicture]:
        """Yield what one side alone gets right, at most so many of each, with pictures as far as they are to be had."""
        together = first.folder == second.folder and first.rows["number"].equals(second.rows["number"])
        sides = {"a": first} if together else {"a": first, "b": second}
        places = far_apart(first, second, most)
        files = {(place, one): f"images/pair-{pair}-{place}-{one}.jpg" for place in places for one in sides}
        self.interrupted = True  # unless it comes to its end
        with suppress(KeyboardInterrupt), interruptible():
            self._make([(sides[one], place, self.folder / name) for (place, one), name in files.items()])
            self.interrupted = False
        for place in places:
            names = [files[place, one] for one in sides]
            values = first.rows.loc[place, first.varying].items()
            yield PairPicture(
                number=place,
                values={name: one if isinstance(one, str) else float(f"{one:.6g}") for name, one in values},
                right=(first if first.right[place] else second).name,
                answers=(first.rows["label"][place], second.rows["label"][place]),
                pictures=names if all((self.folder / name).is_file() for name in names) else [],
            )

    def _make(self, wanted: Sequence[tuple[Side, int, Path]]) -> None:
        """Put the pictures at some places of sides into files, where they are not there."""
        missing: list[tuple[Side, int, Path]] = []
        for side, place, file in wanted:
            number = int(side.rows["number"][place])
            kept = thumbnails.kept_file(side.folder, number)
            if kept is not None:
                write_bytes(file, kept.read_bytes(), durable=False)
            elif not file.is_file():
                missing.append((side, number, file))
        if missing:
            self.progress.stage("rendering pictures again", len(missing), hint="`pictures` says how many")
        for side, number, file in sorted(missing, key=lambda one: (str(one[0].folder), one[1])):
            if side.folder not in self.scenes:
                self.scenes[side.folder] = None
                try:
                    self.scenes[side.folder] = scenes_of(side.config)
                except (InputError, ModelError) as error:  # scene or model are not to be had any more
                    self.warnings.append(f"Pictures of {side.folder.name} are not shown: {error}")
            scenes = self.scenes[side.folder]
            if scenes is not None:
                write_bytes(file, thumbnails.thumbnail(scenes.picture(number)), durable=False)
                self.rendered += 1
            self.progress.advance(1)
