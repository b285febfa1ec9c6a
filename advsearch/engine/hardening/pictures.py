"""The pictures of a training as a data set for any trainer: a folder for each class, and a WebDataset."""

from __future__ import annotations

import io
import json
import re
import tarfile
from collections.abc import Sequence
from pathlib import Path

from advsearch.engine.hardening.lessons import Lesson, RenderedLesson, TextureLesson
from advsearch.files import JsonObject
from advsearch.runs.files import replacing
from advsearch.runs.images import write_png

FOLDER, ARCHIVE = "pictures", "pictures.tar"
KINDS = ("plain", "worst")


def save_pictures(folder: Path, number: int, chosen: Sequence[Lesson], labels: Sequence[str]) -> None:
    """Write the pictures of a round's lessons: ``CLASS/ROUND-LESSON-plain.png`` and ``...-worst.png``.

    Args:
        folder: of the data set.
        number: of the round.
        chosen: lessons.
        labels: names of the model's classes.
    """
    for place, one in enumerate(chosen):
        name = re.sub(r"[^a-z0-9]+", "-", labels[one.right[0]].lower()).strip("-")
        for kind in KINDS if isinstance(one, (TextureLesson, RenderedLesson)) else KINDS[:1]:
            path = folder / f"{one.right[0]:04d}-{name}" / f"{number:03d}-{place:05d}-{kind}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, getattr(one, kind))


def write_archive(folder: Path, archive: Path) -> int:
    """Write the pictures of a data set as a WebDataset and return how many there are.

    Of each there is a ``.png``, a ``.cls`` with the index of its class and a ``.json`` with that and the kind of
    picture. Members have no time and no owner, so that equal pictures make equal files.
    """
    pictures = sorted(folder.glob("*/*.png"))
    with replacing(archive) as part, tarfile.open(part, "w") as tar:
        for path in pictures:
            index, kind = int(path.parent.name[:4]), path.stem.rpartition("-")[2]
            facts: JsonObject = {"class": index, "kind": kind}
            key = f"{path.parent.name}-{path.stem}"
            for suffix, data in (
                ("png", path.read_bytes()),
                ("cls", str(index).encode()),
                ("json", json.dumps(facts).encode()),
            ):
                member = tarfile.TarInfo(f"{key}.{suffix}")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))
    return len(pictures)
