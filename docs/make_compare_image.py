"""Makes the picture of a comparison's page in docs/compare.md.

    python docs/make_compare_image.py RUN

RUN is the folder of a run of `compare`. Chromium draws its page; the upper part is
written to `docs/images/compare.png`, in few colours.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

PICTURE = Path(__file__).resolve().parent / "images" / "compare.png"
WIDTH = 720
HEIGHT = 1220
COLOURS = 256


def main(argv: Sequence[str] | None = None) -> int:
    """Write the picture; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a finished run of compare")
    page = parser.parse_args(argv).run.resolve() / "report.html"
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None or not page.is_file():
        parser.error(f"expected Chromium and {page}")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "page.png"
        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        drawn = [
            f"--window-size={WIDTH},{HEIGHT}",
            f"--screenshot={file}",
            page.as_uri(),
        ]
        subprocess.run([browser, *flags, *drawn], check=True, stderr=subprocess.DEVNULL)
        with Image.open(file) as picture:
            picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(
                PICTURE, optimize=True
            )
    print(f"written: {PICTURE}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
