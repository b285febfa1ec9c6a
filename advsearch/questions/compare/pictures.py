"""Small pictures of pairs that one side alone gets right, in the folder of the run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from advsearch.engine.sweeps.swept_scene import Scenes
from advsearch.errors import InputError, ModelError
from advsearch.question import Asked
from advsearch.questions.compare.answer import PairPicture
from advsearch.questions.compare.pairs import Side, far_apart
from advsearch.questions.sweep.carry_out import scenes_of
from advsearch.runs.files import write_bytes
from advsearch.viewer import thumbnails


@dataclass
class Pictures:
    """Small pictures of pairs in the folder of the run: those that sweeps kept, or rendered again."""

    asked: Asked[Any]
    rendered: int = 0
    warnings: list[str] = field(default_factory=list)
    scenes: dict[Path, Scenes | None] = field(default_factory=dict)

    def of(self, first: Side, second: Side, pair: int) -> Iterator[PairPicture]:
        """Yield what one side alone gets right, at most so many of each, with pictures as far as they are to be had."""
        together = first.folder == second.folder and first.rows["number"].equals(second.rows["number"])
        sides = {"a": first} if together else {"a": first, "b": second}
        places = far_apart(first, second, self.asked.config.pictures)
        files = {(place, one): f"images/pair-{pair}-{place}-{one}.jpg" for place in places for one in sides}
        folder = self.asked.run.path
        with self.asked.until_interrupted():
            self._make([(sides[one], place, folder / name) for (place, one), name in files.items()])
        for place in places:
            names = [files[place, one] for one in sides]
            values = first.rows.loc[place, first.varying].items()
            yield PairPicture(
                number=place,
                values={name: one if isinstance(one, str) else float(f"{one:.6g}") for name, one in values},
                right=(first if first.right[place] else second).name,
                answers=(first.rows["label"][place], second.rows["label"][place]),
                pictures=names if all((folder / name).is_file() for name in names) else [],
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
            self.asked.progress.stage("rendering pictures again", len(missing), hint="`pictures` says how many")
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
            self.asked.progress.advance(1)
