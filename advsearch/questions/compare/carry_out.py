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
from advsearch.questions.compare.settings import CompareConfig
from advsearch.questions.compare.sides import Side, compared, differing, far_apart, interval_of, read_sides, varying
from advsearch.questions.sweep.carry_out import scenes_of
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
        pictures = _Pictures(run.path, progress)
        pairs = []
        for number, other in enumerate(sides[1:], start=1):
            progress.stage("counting pairs")
            pair = _counted(sides[0], other, config.seed, pictures)
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
            warnings=[*_cautions(sides), *pictures.warnings],
            seconds={"total": time.perf_counter() - begun},
            seed=config.seed,
            command_line=config.command_line(),
        )
        return keep_answer(run, result)


def _counted(first: Side, second: Side, seed: int, pictures: _Pictures) -> ComparedPair:
    """Two sides counted; without rules, and why, where the library that finds them is missing."""
    try:
        return compared(first, second, seed)
    except InputError as error:
        text = f"Where one side is worse was not looked for: {error}"
        pictures.warnings += [text] if text not in pictures.warnings else []
        return compared(first, second, seed, rules=False)


def _side(side: Side) -> ComparedSide:
    right, total = int(side.right.sum()), len(side)
    counts = {"configurations": total, "correct": right, "accuracy": right / total}
    interval = interval_of(side.right, side.units)
    named = {"name": side.name, "run": str(side.folder), **side.named}
    return ComparedSide(**named, **counts, interval=interval, seconds=side.seconds)


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
    return list(dict.fromkeys(found))


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
        numbers, columns = far_apart(first, second, most), varying(first.columns)
        together = first.folder == second.folder and bool((first.numbers == second.numbers).all())
        sides = [first] if together else [first, second]
        with suppress(KeyboardInterrupt), interruptible():
            self._make(numbers, sides, pair)
        for number in numbers:
            names = [
                name for place in range(len(sides)) if (self.folder / (name := _name(pair, number, place))).is_file()
            ]
            yield PairPicture(
                number=number,
                values={
                    one.name: float(f"{float(one.data[number]):.6g}")
                    if one.levels is None
                    else one.levels[int(one.data[number])]
                    for one in columns
                },
                right=(first if first.right[number] else second).name,
                answers=(str(first.answers[number]), str(second.answers[number])),
                pictures=names if len(names) == len(sides) else [],
            )

    def _make(self, numbers: Sequence[int], sides: Sequence[Side], pair: int) -> None:
        """Put the pictures of some pairs into the folder."""
        self.interrupted = True  # unless it comes to its end
        missing: list[tuple[Side, int, Path]] = []
        for place, side in enumerate(sides):
            for number in numbers:
                file = self.folder / _name(pair, number, place)
                kept = thumbnails.kept_file(side.folder, int(side.numbers[number]))
                if kept is not None:
                    write_bytes(file, kept.read_bytes(), durable=False)
                elif not file.is_file():
                    missing.append((side, int(side.numbers[number]), file))
        if missing:
            self.progress.stage("rendering pictures again", len(missing), hint="`pictures` says how many")
        for side, number, file in sorted(missing, key=lambda one: (str(one[0].folder), one[1])):
            scenes = self._scenes(side)
            if scenes is not None:
                write_bytes(file, thumbnails.thumbnail(scenes.picture(number)), durable=False)
                self.rendered += 1
            self.progress.advance(1)
        self.interrupted = False

    def _scenes(self, side: Side) -> Scenes | None:
        """What renders pictures of a sweep as it did; None where scene or model are not to be had any more."""
        if side.folder not in self.scenes:
            self.scenes[side.folder] = None
            try:
                self.scenes[side.folder] = scenes_of(side.config)
            except (InputError, ModelError) as error:
                self.warnings.append(f"Pictures of {side.folder.name} are not shown: {error}")
        return self.scenes[side.folder]


def _name(pair: int, number: int, place: int) -> str:
    return f"images/pair-{pair}-{number}-{'ab'[place]}.jpg"
