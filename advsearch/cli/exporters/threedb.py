"""A sweep for the dashboard of 3DB."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from advsearch.runs.directory import find_run
from advsearch.runs.export import write_threedb
from advsearch.runs.exporters import Exported, Exporter
from advsearch.runs.store import NAME, Store
from advsearch.viewer.thumbnails import kept_pictures


class ThreeDB(Exporter):
    """A sweep as a folder for 3DB's dashboard."""

    name = "3db"
    writes = "a folder"
    example = "export mug-sweep-001 --format 3db --out folder"
    options = ("kind",)

    def write(self, run: str, out: Path, options: Mapping[str, Any]) -> Exported:
        directory = find_run(run)
        kept = kept_pictures(directory)
        with Store(directory / NAME, read_only=True) as store:
            picture = kept.png_of if kept else lambda _: None
            count = write_threedb(lambda: store.rows(options["kind"] or "sweep"), out, picture)
        return Exported({"rows": count}, f"{count} rows in {out}; look at them with: python -m threedboard {out}")
