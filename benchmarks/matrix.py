"""What scenes that were searched on one model do to others: the matrix of several models, control by control.

    python benchmarks/matrix.py --model A,B,C --object mug.obj --label "coffee mug,cup" [--controls texture pose]
                                [--keep FOLDER] [more flags of advsearch attack]

Prints a table in Markdown: successes, of how many trials, with their 95 % interval; * where the scene is `found` on
that model too. Weights of MobileNetV2 in torchvision's names, without torchvision: `_mobilenet:MobileNetV2@FILE`.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from advsearch import threads

threads.configure()

from advsearch.cli.main import main as advsearch  # noqa: E402
from advsearch.questions.attack.summary import MatrixResult  # noqa: E402
from advsearch.report.shown import shown  # noqa: E402
from advsearch.runs.summary import read_result  # noqa: E402


def main(argv: Sequence[str] | None = None) -> int:
    """Attack with each control, print one table; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--controls", nargs="+", default=["texture", "pose"])
    parser.add_argument("--keep", type=Path, help="folder for the runs, one of each control")
    args, flags = parser.parse_known_args(argv)
    with tempfile.TemporaryDirectory() as scratch:
        for number, control in enumerate(args.controls):
            run = (args.keep or Path(scratch)) / control
            with contextlib.redirect_stdout(io.StringIO()):
                status = advsearch(["attack", *flags, "--control", control, "--run", str(run)])
            if status:
                return status
            result = read_result(run)
            if not isinstance(result, MatrixResult):
                raise SystemExit("expected several models: --model A,B")
            table = shown(result).sections[0]
            heads = ["control", *table.heads]
            lines = [heads, ["---"] * len(heads)] if not number else []
            for cells in [*lines, *([control, *row] for row in table.rows)]:
                print(f"| {' | '.join(cells)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
