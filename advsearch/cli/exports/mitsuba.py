"""The adversarial scene for Mitsuba."""

from __future__ import annotations

import argparse
from pathlib import Path

from advsearch.cli.exports import Written

FORMAT = "mitsuba"
WRITES = "an XML file and what belongs to it, or a new folder for them"
ENDING = "xml"
EXAMPLE = "export mug-texture-001 --format mitsuba --out folder"


def write(args: argparse.Namespace, out: Path) -> Written:
    """Write the adversarial scene."""
    # late, so that --help answers at once
    from advsearch.cli.output import at_work

    with at_work(as_json=True, quiet=False):
        # late, so that --help answers at once
        from advsearch.api.export import write_mitsuba

        notes = write_mitsuba(args.run, out)
    return {"notes": notes}, " ".join([f"The scene is in {out}.", *notes])
