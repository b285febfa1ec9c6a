"""The kept pictures as a dataset for FiftyOne."""

from __future__ import annotations

import argparse
from pathlib import Path

from advsearch.cli.exports import Written

FORMAT = "fiftyone"
WRITES = "a folder"
EXAMPLE = "export mug-sweep-001 --format fiftyone --out folder"


def write(args: argparse.Namespace, out: Path) -> Written:
    """Write a dataset of the pictures that were kept."""
    # late, so that --help answers at once
    from advsearch.runs.directory import find_run
    from advsearch.runs.fiftyone import write_fiftyone
    from advsearch.viewer.thumbnails import name_of_object, pictured

    folder = find_run(args.run)
    count = write_fiftyone(lambda: pictured(folder), out, folder.resolve().name, name_of_object(folder))
    return {"samples": count}, f"{count} samples in {out}, a fiftyone.types.FiftyOneDataset"
