"""Collect small images of pairs that only one side gets right."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import pandas as pd

from advsearch.extend import InputError, RunContext, errors
from advsearch.questions.compare.result import PairPicture
from advsearch.questions.compare.sides import Side


class MissingImage(NamedTuple):
    """An image that has to be rendered.

    Attributes:
        side: side that it belongs to.
        number: number of the image in the side's sweep.
        file: relative to the run directory.
    """

    side: Side
    number: int
    file: str


@dataclass
class PairImages:
    """Copies images of pairs into the run directory, or renders them again.

    Attributes:
        context: context of the experiment.
        n_rendered: images that were rendered.
        warnings: sentences about images that could not be rendered.
    """

    context: RunContext[Any]
    n_rendered: int = 0
    warnings: list[str] = field(default_factory=list)
    _unavailable: set[str] = field(default_factory=set)

    def list_examples(
        self, first: Side, second: Side, pair_number: int
    ) -> Iterator[PairPicture]:
        """Yield pairs in which only one prediction is right, largest differences first.

        The difference is that of the margins. The setting `pictures` limits the number
        of pairs in favor of each side. Their images are stored in the run. A pair whose
        images could not all be stored is yielded without images.

        Args:
            first, second: the sides, with rows in the same order.
            pair_number: number of these two sides, for the names of the files.
        """
        run = self.context.run
        rows = select_examples(first, second, self.context.config.pictures)
        side_of_letter = {"a": first, "b": second}
        if _has_same_images(first, second):  # store each image once
            side_of_letter.pop("b")
        files = {
            row: _name_files(pair_number, row, list(side_of_letter)) for row in rows
        }
        self._save_images(rows, list(side_of_letter.values()), files, run)
        for row in rows:
            is_complete = all((run.path / file).is_file() for file in files[row])
            yield _make_pair_picture(
                first, second, row, files[row] if is_complete else []
            )

    def _save_images(
        self,
        rows: Sequence[int],
        sides: Sequence[Side],
        files: Mapping[int, Sequence[str]],
        run: Any,
    ) -> None:
        """Store the images of rows: thumbnails of the sweeps, or else renderings.

        If the user interrupts, the remaining images are not stored.

        Args:
            rows: indices of the pairs whose images are stored.
            sides: sides with images of their own.
            files: for each row its files, in the order of `sides`.
            run: the run directory.
        """
        missing = []
        with self.context.until_interrupted():
            for row in rows:
                for side, file in zip(sides, files[row], strict=True):
                    number = int(side.rows["number"][row])
                    is_copied = self._copy_thumbnail(side, number, file)
                    if not is_copied and not (run.path / file).is_file():
                        missing.append(MissingImage(side, number, file))
            self._render(missing)

    def _copy_thumbnail(self, side: Side, number: int, file: str) -> bool:
        """Copy an image of a sweep into the run; return whether the sweep has stored it.

        A resumed run copies it again, which is cheap.

        Args:
            side: side that the image belongs to.
            number: number of the image in the side's sweep.
            file: where it is stored, relative to the run directory.
        """
        stored = side.sweep.find_thumbnail(number)
        if stored is None:
            return False
        self.context.run.write_file(file, stored.read_bytes())
        return True

    def _render(self, missing: Sequence[MissingImage]) -> None:
        """Render images again, sweep by sweep, so that each scene is loaded once."""
        if missing:
            self.context.progress.stage(
                "rendering pictures again",
                len(missing),
                hint="`pictures` limits how many",
            )
        for image in sorted(
            missing, key=lambda image: (str(image.side.sweep.folder), image.number)
        ):
            self._render_image(image)
            self.context.progress.advance(1)

    def _render_image(self, image: MissingImage) -> None:
        """Render an image again, and store it.

        If its scene or model is not available, there is a warning instead.
        """
        sweep = image.side.sweep
        if str(sweep.folder) in self._unavailable:
            return
        try:
            scenes = sweep.scenes
        except (InputError, errors.ModelError) as error:
            # A scene or a model is no longer available.
            self._unavailable.add(str(sweep.folder))
            self.warnings.append(
                f"Pictures of {sweep.folder.name} are not shown: {error}"
            )
            return
        self.context.run.write_file(image.file, scenes.render_thumbnail(image.number))
        self.n_rendered += 1


def _name_files(pair_number: int, row: int, letters: Sequence[str]) -> list[str]:
    """Return the files of the images of a pair, relative to the run, by side."""
    return [f"images/pair-{pair_number}-{row}-{letter}.jpg" for letter in letters]


def _has_same_images(first: Side, second: Side) -> bool:
    """Return whether the images of two sides are the same: two models of one sweep."""
    # The column "number" has the number of each image in its sweep.
    return first.sweep.folder == second.sweep.folder and first.rows["number"].equals(
        second.rows["number"]
    )


def _make_pair_picture(
    first: Side, second: Side, row: int, files: list[str]
) -> PairPicture:
    """Describe a pair that only one side gets right.

    Args:
        first, second: the sides.
        row: index of the pair.
        files: images of the pair, relative to the run directory.
    """
    right_side = first if first.is_right[row] else second
    return PairPicture(
        number=row,
        values=_round_values(first, row),
        right=right_side.name,
        answers=(first.rows["label"][row], second.rows["label"][row]),
        pictures=files,
    )


def _round_values(side: Side, row: int) -> dict[str, str | float]:
    """Return the values of a row's parameters, numbers with six digits."""
    values = side.rows.loc[row, side.varying_parameters].items()
    return {
        name: value if isinstance(value, str) else float(f"{value:.6g}")
        for name, value in values
    }


def select_examples(first: Side, second: Side, limit: int) -> list[int]:
    """Return the row labels of the pairs in which only one side is right.

    There are at most `limit` pairs for each side. The largest differences of the
    margins come first; an unknown difference counts as 0.
    """
    # The margin is positive where a prediction is right, and so the difference is
    # positive where only the first side is right and negative where only the second is.
    margin_gap = (first.rows["margin"] - second.rows["margin"]).fillna(0.0)
    only_first_right = first.is_right & ~second.is_right
    only_second_right = ~first.is_right & second.is_right
    return [
        *find_smallest(-margin_gap[only_first_right], limit),
        *find_smallest(margin_gap[only_second_right], limit),
    ]


def find_smallest(values: pd.Series, limit: int) -> list[int]:
    """Return the row labels of the smallest values, in ascending order."""
    indices: list[int] = values.sort_values(kind="stable").index[:limit].tolist()
    return indices
