"""Rounds of search and training, each kept in the run when it is done: its weights, its pictures and its score.

What a round learned costs clean accuracy; part of the way from the weights that were given to the trained ones costs
less of it than of what was learned (Wortsman et al. 2022, arXiv 2109.01903), so that each round ends with the part that
is best, and the next one begins there.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from safetensors import torch as safetensors

from advsearch import threads
from advsearch.engine.hardening.lessons import Lesson, harder
from advsearch.engine.hardening.pictures import ARCHIVE, FOLDER, save_pictures, write_archive
from advsearch.engine.hardening.split import TRAINING, VALIDATION
from advsearch.engine.hardening.training import Course, Score, score
from advsearch.progress import Progress
from advsearch.report.phrases import percent
from advsearch.runs.directory import ARTIFACTS, RunDirectory
from advsearch.runs.files import write_bytes
from advsearch.runs.results.harden import TrainingRound

WEIGHTS = "hardened.safetensors"
ROUNDS = "rounds"
"""The note under which the store keeps the scores."""
FIRST_STEPS = 4
"""Steps of each texture before a training."""
VALIDATION_VIEWS, JUDGED = 2, 168
PARTS = (1.0, 0.85, 0.7, 0.55, 0.4, 0.25)
"""Of the way from the weights that were given to the trained ones, which are judged."""

Draw = Callable[[str, str, Sequence[int], int], list[Lesson]]
"""From what to tell the progress, the name of a split, numbers of its scenes and the views of each to lessons."""


@dataclass
class TrainingRounds:
    """The rounds of a run.

    Attributes:
        run: keeps them.
        course: trains.
        draw: draws lessons.
        progress: told how far it is.
        done: what each round came to; the first is the model as it was.
    """

    run: RunDirectory
    course: Course
    draw: Draw
    progress: Progress
    done: list[TrainingRound] = field(init=False)

    def __post_init__(self) -> None:
        noted = json.loads(self.run.store.note(ROUNDS) or "[]")
        self.done = [TrainingRound.of(one) for one in noted]

    @property
    def judged(self) -> int:
        """Scenes by which weights are chosen, for each control: a third as many as a round adds, up to `JUDGED`."""
        return min(-(-self.course.config.scenes // 3), JUDGED)

    @property
    def best(self) -> int:
        """The round whose weights are kept: the most robust one whose clean accuracy is within what may be lost."""
        allowed = [number for number, one in enumerate(self.done) if self._allowed(one.clean)]
        return max(allowed, key=lambda number: (self.done[number].robust, number))

    def _allowed(self, clean: float) -> bool:
        return clean >= self.done[0].clean - self.course.config.clean_loss - 1e-9

    def carry_out(self) -> None:
        """Do what is left of the rounds; the student has the best weights afterwards, which the run keeps."""
        if len(self.done) <= self.course.config.rounds:
            self._train()
        student = self.course.student
        student.net.load_state_dict(self._weights(self.best))
        self._save(WEIGHTS)
        folder = self.run.path / ARTIFACTS
        write_archive(folder / FOLDER, folder / ARCHIVE)

    def _train(self) -> None:
        student, config, pool, begun = self.course.student, self.course.config, list[Lesson](), 0
        held_back = self.draw("drawing scenes to choose weights by", VALIDATION, range(self.judged), VALIDATION_VIEWS)
        if not self.done:
            self._keep(0, [], score(student.model, held_back), 0, 0.0)
        for number in range(1, config.rounds + 1):
            places = range((number - 1) * config.scenes, number * config.scenes)
            new = self.draw(f"round {number}: drawing scenes", TRAINING, places, config.views)
            pool += new
            if number < len(self.done):
                continue  # done before this run was stopped
            student.net.load_state_dict(self._weights(number - 1))
            self.progress.stage(f"round {number}: training", self.course.steps(pool))
            with threads.all_for_torch():
                harder(pool[begun:], student.model, FIRST_STEPS)  # the others are as hard as their training left them
                self.course.round(number, pool, lambda: self.progress.advance(1))
                found, part = self._mixed(held_back)
            begun = len(pool)
            self._keep(number, new, found, len(pool), part)

    def _mixed(self, held_back: Sequence[Lesson]) -> tuple[Score, float]:
        """Leave the student with the best part of the way from the weights that were given; return its score and it.

        The best one is right most often on the worst pictures among those that lose no more on plain ones than they
        may; where all lose more, it is the one that loses least. Less of the way learned less: once that shows, the
        smaller parts are not looked at, as each costs a search of its own.
        """
        student, given = self.course.student, self._weights(0)
        learned = {name: one.clone() for name, one in student.net.state_dict().items()}

        def take(part: float) -> None:
            mixed = {name: torch.lerp(given[name], one, part) if one.is_floating_point() else one
                     for name, one in learned.items()}  # fmt: skip
            student.net.load_state_dict(mixed)

        found = dict[float, Score]()
        for part in PARTS:
            take(part)
            found[part] = score(student.model, held_back)
            robust = [one.robust for one in found.values() if self._allowed(one.clean)]
            if robust and robust[-1] < max(robust):
                break
        allowed = [part for part, one in found.items() if self._allowed(one.clean)]
        best = max(allowed, key=lambda part: found[part].robust, default=max(found, key=lambda part: found[part].clean))
        take(best)
        return found[best], best

    def _keep(self, number: int, new: Sequence[Lesson], found: Score, trained: int, part: float) -> None:
        """Keep weights, what they came to, and the round's pictures."""
        model = self.course.student.model
        self._save(_file(number))
        save_pictures(self.run.path / ARTIFACTS / FOLDER, number, new, model.labels)
        done = TrainingRound(lessons=trained, part=part, clean=found.clean, robust=found.robust, kept=False)
        self.done.append(done)
        self.run.store.set_note(ROUNDS, json.dumps([one.model_dump() for one in self.done]))
        clean, worst = percent(found.clean), percent(found.robust)
        self.progress.message(f"round {number}: {clean} of plain pictures right, {worst} of the worst")

    def _save(self, name: str) -> None:
        state = {key: one.contiguous() for key, one in self.course.student.net.state_dict().items()}
        write_bytes(self.run.path / ARTIFACTS / name, safetensors.save(state))

    def _weights(self, number: int) -> dict[str, torch.Tensor]:
        return safetensors.load((self.run.path / ARTIFACTS / _file(number)).read_bytes())


def _file(number: int) -> str:
    return f"round-{number:03d}.safetensors"
