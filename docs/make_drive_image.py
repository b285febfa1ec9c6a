"""Makes the strip that docs/drives.md shows: `docs/images/drive.png`.

    python docs/make_drive_image.py

It is the worst drive of the sweep that the page begins with.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import advsearch

PICTURE = Path(__file__).resolve().parent / "images" / "drive.png"


def main() -> int:
    """Sweep and copy; returns the exit status."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        advsearch.sweep(
            "mug",
            grid={"pose.yaw": "0:360:4"},
            environment="studio,noon",
            path="approach",
            fps=1,
            trials=0,
            run=run,
        )
        shutil.copyfile(run / "images" / "drive.png", PICTURE)
    print(
        f"written: {PICTURE.relative_to(PICTURE.parent.parent.parent)}", file=sys.stderr
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
