"""Exporters: what writes a run in another format, by the word of `advsearch export
--format`.

A package outside adds its own (docs/extending.md).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from advsearch.catalog import list_built_ins
from advsearch.progress import Progress
from advsearch.registry import Registry
from advsearch.runs.files import write_png


class Exported(NamedTuple):
    """What to report of an export.

    Attributes:
        facts: fields of `advsearch export --json`.
        text: the same in words.
    """

    facts: dict[str, object]
    text: str


class Exporter(ABC):
    """Write a run in another format than a table of its rows.

    Attributes:
        name: the word of `--format`.
        writes: what the name after `--out` is of: "a PDF file".
        example: a command line without `advsearch` in front.
        suffix: suffix of files that are of this format if no other is requested,
            without the dot; by default the name.
        options: flags of `advsearch export` that belong to it: "size".
    """

    name: ClassVar[str]
    writes: ClassVar[str]
    example: ClassVar[str]
    suffix: ClassVar[str] = ""
    options: ClassVar[tuple[str, ...]] = ()
    write_png = staticmethod(write_png)

    @abstractmethod
    def write(
        self, run: str, out: Path, options: Mapping[str, Any], progress: Progress
    ) -> Exported:
        """Write a run. What libraries print meanwhile does not reach standard output.

        Args:
            run: the run's name or directory, see `advsearch.runs.directory.find_run`.
            out: the file or directory to write.
            options: the values of `options`; None where one was not given.
            progress: is told of long work.

        Raises:
            AdvsearchError: the run cannot be exported, or `out` cannot be written.
        """


EXPORTERS: Registry[type[Exporter]] = Registry(
    "advsearch.exporters",
    list_built_ins("exporter"),
    "a subclass of Exporter whose name is that of the entry point",
    lambda name, entry: (
        isinstance(entry, type) and issubclass(entry, Exporter) and entry.name == name
    ),
)
"""Every exporter by its word, imported when it is used."""
