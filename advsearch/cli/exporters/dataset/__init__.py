"""Export the images of a run as a dataset with bounding boxes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from advsearch.extend import Exported, Exporter, InputError, Progress


class _Dataset(Exporter):
    writes = "a folder"
    options = ("all",)

    def write(
        self, run: str, out: Path, options: Mapping[str, Any], progress: Progress
    ) -> Exported:
        """Write the images of a run as a dataset of boxes.

        Args:
            run: name or folder of the run.
            out: the folder, which is made, or empty.
            options: `all` is set to write also images that models are right about.
            progress: reports the rows.

        Raises:
            InputError: there are no images to write.
        """
        from advsearch.cli.exporters.dataset.files import write_dataset  # takes seconds

        every = bool(options["all"])
        count, notes = write_dataset(
            run, out, self.name, every=every, progress=progress
        )
        if not count:
            raise InputError(
                f"{run}: no model is wrong in a picture of its rows; "
                "--all takes the others too"
            )
        text = " ".join([f"{count} pictures in {out}.", *notes])
        return Exported({"pictures": count, "notes": notes}, text)


class Coco(_Dataset):
    """The pictures with boxes and masks, in the format of COCO."""

    name = "coco"
    example = "export mug-sweep-001 --format coco --out folder"


class Yolo(_Dataset):
    """The pictures with boxes, to train a YOLO."""

    name = "yolo"
    example = "export mug-sweep-001 --format yolo --out folder"
