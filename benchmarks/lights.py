"""A sweep over light for one pose by basis pictures, over rendering each: configurations a second, and verdicts.

    python benchmarks/lights.py [--object mug] [--model reference] [--label mug] [--turns 5] [--rendered 64]

Power of a lamp, exposure and tint of the environment and exposure of the camera are swept over a grid, from a picture
that is nearly black to one that is nearly white. In each turn some rows of it are rendered and the whole of it is
predicted, in one process; figures are medians of the turns' ratios (asked for: 20):

- once the basis pictures are made, with the model and without it;
- as a whole: basis pictures, comparisons and store included;
- the rows of the last turn in which both say the same, right or wrong; and in which two rendered ones with other seeds
  do.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from unittest import mock

from advsearch import threads

threads.configure()

from advsearch.attacks.domain import Seeds  # noqa: E402
from advsearch.questions.sweep.carry_out import job_of  # noqa: E402
from advsearch.questions.sweep.job import KIND, SweptScene  # noqa: E402
from advsearch.questions.sweep.settings import SweepConfig  # noqa: E402
from advsearch.tasks import Judgement  # noqa: E402

ASKED = 20
GRID = {
    "camera.exposure": "-5:5:16",
    "light.power": "0:12:8",
    "environment.exposure": "-2:2:4",
    "environment.tint_red": "0.2:2:2",
}
BATCH = 16


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--object", default="mug")
    parser.add_argument("--model", default="reference")
    parser.add_argument("--labels")
    parser.add_argument("--label")
    parser.add_argument("--resolution", type=int)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--rendered", type=int, default=64, help="rows that are rendered in a turn (default 64)")
    args = parser.parse_args()
    side = args.resolution
    named = {"object": args.object, "model": args.model, "labels": args.labels, "label": args.label}
    config = SweepConfig(**named, grid=GRID, trials=0, resolution=side and (side, side))
    turns = [Turn(config, args.rendered) for _ in range(args.turns + 1)][1:]
    print(f"{args.object}, {args.model}; configurations a second over rendering each, medians of {args.turns} turns")
    for name in ("model", "alone", "whole"):
        ratios = [getattr(one, name) for one in turns]
        low, middle, high = statistics.quantiles(ratios, n=4)
        print(f"  {WHAT[name]:46s} {middle:7.1f}  ({low:.1f}-{high:.1f})  asked for {ASKED}")
    last = turns[-1]
    print(f"  same verdict in {last.same} of {last.compared} rows, {last.right} of them right; {last.error}")
    print(f"  same verdict in {last.again} of these rendered twice")


WHAT = {
    "model": "once basis pictures are made, with the model",
    "alone": "likewise, pictures without the model",
    "whole": "as a whole, basis pictures and checks included",
}


class Turn:
    """Some rows rendered, all of them predicted.

    Attributes:
        model, alone, whole: ratios, see `WHAT`.
        same, compared, right, again: rows.
        error: of the worst comparison, in words.
    """

    def __init__(self, config: SweepConfig, rendered: int) -> None:
        predicting, rendering = (SweptScene(job_of(one), 0) for one in (config, off(config)))
        count = next(iter(predicting.points.values())).count
        blocks = max(1, rendered // BATCH)
        rows = [first + k for first in range(0, count, count // blocks // BATCH * BATCH) for k in range(BATCH)]
        Looks(rendering, [0])  # compiles
        each, again = Looks(rendering, rows), Looks(rendering, rows, root=1)
        begun = time.perf_counter()
        Looks(predicting, [0])
        making = time.perf_counter() - begun
        found = Looks(predicting, range(count))
        self.model = each.seconds / found.seconds
        self.alone = each.without / found.without
        self.whole = each.seconds * count / (found.seconds * count + making)
        pairs = [(one.right, found.judgements[number].right) for number, one in zip(rows, each.judgements, strict=True)]
        self.compared, self.same = len(pairs), sum(one == other for one, other in pairs)
        self.right = sum(one for one, _ in pairs)
        both = zip(each.judgements, again.judgements, strict=True)
        self.again = sum(one.right == other.right for one, other in both)
        told = next(iter(predicting.predicted.values())).summary()
        assert told is not None and told.used and told.error is not None, told
        self.error = f"off by at most {told.error.levels:.2f} levels, {told.error.logits:+.2f} logits"


def off(config: SweepConfig) -> SweepConfig:
    """The same without predicted pictures."""
    return config.model_copy(update={"specialise": False})


class Looks:
    """Looks at rows of a scene in batches of neighbours.

    Attributes:
        seconds, without: a row, with and without the model.
        judgements: of the first model.
    """

    def __init__(self, view: SweptScene, rows: Sequence[int], root: int = 0) -> None:
        seeds = Seeds(root, KIND)
        self.judgements: list[Judgement] = []
        model, begun = 0.0, time.perf_counter()

        def judged(*given):  # type: ignore[no-untyped-def]
            nonlocal model
            before = time.perf_counter()
            found = judge(*given)
            model += time.perf_counter() - before
            return found

        judge = view.problems[0].judge_several
        with mock.patch.object(view.problems[0], "judge_several", judged):
            for first in range(0, len(rows), BATCH):
                part = rows[first : first + BATCH]
                asked = view.job.queries(range(part[0], part[0] + len(part)))
                queries = [replace(query, seed=seeds(query.number)) for _, _, query in asked]
                self.judgements += [one.said for one in view.evaluate_all(queries)]
        spent = time.perf_counter() - begun
        self.seconds, self.without = spent / len(rows), (spent - model) / len(rows)


if __name__ == "__main__":
    main()
