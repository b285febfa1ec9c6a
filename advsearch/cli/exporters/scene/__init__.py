"""The adversarial scene or its object for other programs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from advsearch.extend import Exported, Exporter, Progress


class Gltf(Exporter):
    """The adversarial object as glTF."""

    name = "gltf"
    writes = "a .glb file"
    example = "export mug-texture-001 --format gltf --out mug.glb"
    suffix = "glb"

    def write(
        self, run: str, out: Path, options: Mapping[str, Any], progress: Progress
    ) -> Exported:
        """See `Exporter.write`."""
        from advsearch.cli.exporters.scene.files import write_gltf  # takes seconds

        notes = write_gltf(run, out)
        return Exported(
            {"notes": notes}, " ".join([f"The object is in {out}.", *notes])
        )


class MitsubaExport(Exporter):
    """The adversarial scene for Mitsuba."""

    name = "mitsuba"
    writes = "an XML file and what belongs to it, or a new folder for them"
    example = "export mug-texture-001 --format mitsuba --out folder"
    suffix = "xml"

    def write(
        self, run: str, out: Path, options: Mapping[str, Any], progress: Progress
    ) -> Exported:
        from advsearch.cli.exporters.scene.files import write_mitsuba  # takes seconds

        notes = write_mitsuba(run, out)
        return Exported({"notes": notes}, " ".join([f"The scene is in {out}.", *notes]))
