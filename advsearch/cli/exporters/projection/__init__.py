"""Export what a projector projects onto the object."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from advsearch.extend import Exported, Exporter, Progress


class Projection(Exporter):
    """The picture of a projector, and marks to align it."""

    name = "projector"
    writes = "a new folder"
    example = "export mug-projector-001 --format projector --out folder"

    def write(
        self, run: str, out: Path, options: Mapping[str, Any], progress: Progress
    ) -> Exported:
        """See `Exporter.write`."""
        # takes seconds
        from advsearch.cli.exporters.projection.images import write_projection

        notes = write_projection(run, out)
        return Exported(
            {"notes": notes}, "\n".join([f"What to project is in {out}. Set:", *notes])
        )
