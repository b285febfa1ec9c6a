"""The adversarial object as glTF."""

from __future__ import annotations

import argparse
from pathlib import Path

from advsearch.cli.exports import Written

FORMAT = "gltf"
WRITES = "a .glb file"
ENDING = "glb"
EXAMPLE = "export mug-texture-001 --format gltf --out mug.glb"


def write(args: argparse.Namespace, out: Path) -> Written:
    """Write the adversarial object."""
    # late, so that --help answers at once
    from advsearch.cli.output import at_work

    with at_work(as_json=True, quiet=False):
        # late, so that --help answers at once
        from advsearch.api.export import write_gltf

        notes = write_gltf(args.run, out)
    return {"notes": notes}, " ".join([f"The object is in {out}.", *notes])
