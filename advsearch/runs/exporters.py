"""Exporters, which write a run in the format of `advsearch export --format`.

Other packages may add exporters (docs/extending.md).
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
    """A report of an export.

    Attributes:
        facts: fields of the output of `advsearch export --json`.
        text: the same as text.
    """

    facts: dict[str, object]
    text: str


class Exporter(ABC):
    """The base class of exporters, for formats other than a table of rows.

    Attributes:
        name: name of the format, the value of `--format`.
        writes: kind of the file or folder that `--out` names, such as "a PDF file".
        example: example of a command line, without `advsearch`.
        suffix: suffix of files, without the dot, that are written in this format if
            `--format` is missing; empty if it is the name.
        options: flags of `advsearch export` that belong to this format, such as
            "size".
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
            options: the values of `options`; None for flags that were not used.
            progress: object that displays the progress of long work.

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
"""Every exporter by the name of its format, imported when it is used."""
