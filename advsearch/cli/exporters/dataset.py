"""The images of a run as a dataset of boxes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from advsearch.cli.output import at_work
from advsearch.errors import InputError
from advsearch.runs.exporters import Exported, Exporter


class _Dataset(Exporter):
    writes = "a folder"
    options = ("all",)

    def write(self, run: str, out: Path, options: Mapping[str, Any]) -> Exported:
        with at_work(as_json=True, quiet=False) as progress:
            from advsearch.api.dataset import write_dataset  # takes seconds

            count, notes = write_dataset(run, out, self.name, every=bool(options["all"]), progress=progress)
        if not count:
            raise InputError(f"{run}: no model is wrong in a picture of its rows; --all takes the others too")
        return Exported({"pictures": count, "notes": notes}, " ".join([f"{count} pictures in {out}.", *notes]))


class Coco(_Dataset):
    """The pictures with boxes and masks, as COCO has them."""

    name = "coco"
    example = "export mug-sweep-001 --format coco --out folder"


class Yolo(_Dataset):
    """The pictures with boxes, to train a YOLO."""

    name = "yolo"
    example = "export mug-sweep-001 --format yolo --out folder"
