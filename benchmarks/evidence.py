"""Seven runs as of one day's work on a model, their evidence, and every figure of it
read against the rows.

    python benchmarks/evidence.py --out card                                     # bundled
        mug and model, two minutes
    python benchmarks/evidence.py --out card --model detector.pt2 --labels coco90 --label
        car --resolution 160

With the bundled model a mug in four rooms, with a detector a car in the avenue by day,
in the rain, at dusk and at night: a sweep over these and over distances, its rules, a
drive, an attack, its paint beside the clean object, their comparison, and a gate. Then
the lines of ``evidence.md`` that say how often something is so are read: counts, shares
and intervals are counted here again from `results.sqlite`, by formulas of their own
(but for the bets of drives and gates, which `drives.py` and `sequential.py` measure),
and each number of a line has to be one of these, a value that varied, or a setting.
Exits with 3 where one is not.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.stats import beta, binom, binomtest, norm

from advsearch.cli.main import main as advsearch
from advsearch.report.wording import format_interval, format_number, percent
from advsearch.runs.store import Row, Store
from advsearch.runs.tables import read_units
from advsearch.statistics.clustered import mean_interval, rate_interval
from advsearch.statistics.sequential import ConfidenceSequence

Interval = tuple[float, float]
RUNS = ("weather", "rules", "drive", "paint", "beside", "clean-and-paint", "gate")
SHARE = re.compile(
    r"(\d+) of (\d+)[^;.]*?(?:95 % interval|\() ?([\d.]+(?:-| to "
    r")[\d.]+)"
)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="folder for the runs and the evidence"
    )
    parser.add_argument(
        "--model",
        help="a detector of cars; left out, the bundled classifier and the bundled mug",
    )
    parser.add_argument("--labels", default="coco90", help="its names")
    parser.add_argument("--label", default="car", help="what is right")
    parser.add_argument("--resolution", default="64", help="of pictures (default 64)")
    parser.add_argument(
        "--samples",
        default="12",
        help="draws at each of 16 or 20 conditions (default 12)",
    )
    parser.add_argument(
        "--read", action="store_true", help="only read what lies in the folder"
    )
    args = parser.parse_args()
    if not args.read:
        make(args)
    sys.exit(3 if check(args.out) else 0)


def make(args: argparse.Namespace) -> None:
    """Make the runs and the evidence, by the commands that a person types."""
    out = args.out
    setting: dict[str, Any] = {"object": "mug", "resolution": int(args.resolution)}
    places = ["studio", "loft", "kitchen", "noon"]
    distances = "0.2,0.35,0.6,1"
    azimuth = [0, 360]
    if args.model:
        task = {
            "task": "detection",
            "model": args.model,
            "labels": args.labels,
            "label": args.label,
        }
        setting |= {"object": "car"} | task
        places = ["avenue", "avenue-wet", "avenue-dusk", "avenue-night"]
        distances = "8,15,25,40,60"
    common = [
        word for name, value in setting.items() for word in (f"--{name}", str(value))
    ]
    common += ["--spp", "4", "--seed", "3", "--quiet"]
    camera = {"azimuth": azimuth, "elevation": [5, 40]}
    claims = {
        name: {"claim": "right", "at_least": least, "pictures": 60,
               "settings": {"environment": place, "controls": {"camera": camera}}}
        for name, least, place in (("by-the-first-light", 0.9, places[0]), ("by-the-last-light", 0.5, places[-1]))
    }  # fmt: skip
    suite = {
        "title": "What it has to hold",
        "settings": setting | {"verify_spp": 4},
        "claims": claims,
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / "suite.yaml").write_text(yaml.safe_dump(suite))
    (out / "common.yaml").write_text(
        yaml.safe_dump({"environment": dict(zip(places, (5, 2, 2, 1), strict=True))})
    )
    at = {name: str(out / name) for name in RUNS}
    seek = ["--objective", "vanish"] if args.model else []
    commands = {
        "weather": ["sweep", *common, "--environment", ",".join(places), "--grid", f"camera.distance={distances}",
                    "--control", f"camera={json.dumps(camera)}", "--samples", args.samples, "--trials", "0"],
        "rules": ["explain", at["weather"], "--confirm", "40", "--pairs", "1", "--clusters", "0", "--quiet"],
        "drive": ["sweep", *common, "--environment", places[0], "--path", "approach", "--fps", "1", "--grid",
                  "pose.yaw=0:360:6", "--trials", "0"],
        "paint": ["attack", *common, "--environment", places[0], "--control", "texture", "--epsilon", "0.3", *seek,
                  "--steps", "8", "--trials", "8"],
        "beside": ["sweep", "--adversarial-of", at["paint"], "--grid", "camera.azimuth=0:360:12", "--trials", "0",
                   "--quiet"],
        "clean-and-paint": ["compare", at["beside"], "--pictures", "2", "--quiet"],
        "gate": ["test", str(out / "suite.yaml"), "--quiet"],
    }  # fmt: skip
    for name, words in commands.items():
        if not (Path(at[name]) / "summary.json").is_file():
            advsearch([*words, "--run", at[name], "--overwrite"])
            if not (Path(at[name]) / "summary.json").is_file():
                raise SystemExit(f"{name} came to no result")
    said = [
        "--criterion",
        "0.9",
        "--exposure",
        str(out / "common.yaml"),
        "--by",
        "benchmarks/evidence.py",
    ]
    if advsearch(
        [
            "report",
            *at.values(),
            "--evidence",
            "--out",
            str(out / "card"),
            "--overwrite",
            *said,
            "--json",
        ]
    ):
        raise SystemExit("no evidence was written")


# ---- what the rows say
# ---------------------------------------------------------------------------


def exact(right: int, of: int, sure: float = 0.95) -> Interval:
    """The interval of Clopper and Pearson (1934)."""
    tail = (1.0 - sure) / 2.0
    low = 0.0 if right == 0 else float(beta.ppf(tail, right, of - right + 1))
    return low, 1.0 if right == of else float(
        beta.ppf(1.0 - tail, right + 1, of - right)
    )


def wilson(right: int, of: int) -> Interval:
    """The interval of Wilson (1927), by which Newcombe's for a difference goes."""
    z = float(norm.ppf(0.975))
    middle = right + z * z / 2.0
    half = z * math.sqrt(right * (of - right) / of + z * z / 4.0)
    return (middle - half) / (of + z * z), (middle + half) / (of + z * z)


def newcombe(
    both: int, first: int, second: int, neither: int
) -> tuple[float, Interval]:
    """The difference of two paired shares, and Newcombe's interval (1998, his
    tenth).
    """
    n = both + first + second + neither
    one = both + first
    other = both + second
    (l1, u1) = wilson(one, n)
    (l2, u2) = wilson(other, n)
    product = one * (n - one) * other * (n - other)
    phi = 0.0
    if product:
        covered = float(both * neither - first * second)
        covered = max(covered - n / 2.0, 0.0) if covered > 0 else covered
        phi = covered / math.sqrt(product)
    p1 = one / n
    p2 = other / n
    d = (other - one) / n
    below = math.sqrt((p2 - l2) ** 2 - 2 * phi * (p2 - l2) * (u1 - p1) + (u1 - p1) ** 2)
    above = math.sqrt((u2 - p2) ** 2 - 2 * phi * (u2 - p2) * (p1 - l1) + (p1 - l1) ** 2)
    return d, (d - below, d + above)


def shown(rows: Sequence[Row]) -> list[Row]:
    """Those with the object in the picture: no share counts the others."""
    return [row for row in rows if row.label != "out of view"]


class Counted:
    """What may stand in a run's lines: counts with their interval, and other numbers as
    they are written.
    """

    def __init__(self) -> None:
        self.shares: dict[tuple[int, int], list[str]] = {}
        self.numbers: set[str] = {"95", "0", "1"}

    def share(self, right: int, of: int, interval: Interval | None = None) -> None:
        """Let so many of so many stand there, with this interval or that of Clopper and
        Pearson.
        """
        ends = exact(right, of) if interval is None else interval
        self.shares.setdefault((right, of), []).append(format_interval(ends))
        self.let(right, of, percent(right / of), format_interval(ends))

    def let(self, *told: object) -> None:
        """Let these numbers stand there."""
        for one in told:
            self.numbers |= {
                found.lstrip("+-")
                for found in NUMBER.findall(str(one).replace("-", " "))
            }
            self.numbers |= {found.lstrip("+-") for found in NUMBER.findall(str(one))}


def rows_of(run: Path, kind: str = "sweep") -> list[Row]:
    with Store(run / "results.sqlite", read_only=True) as store:
        return list(store.rows(kind))


def over_units(run: Path, rows: Sequence[Row]) -> Interval | None:
    """The interval by bets, where rows share a draw; None where each is a draw of its
    own.
    """
    with Store(run / "results.sqlite", read_only=True) as store:
        units = read_units(store)
    if units is None:
        return None
    mine: dict[int, list[bool]] = {}
    for row, unit in zip(
        rows,
        units.find_unit(np.array([row.step for row in rows])).tolist(),
        strict=True,
    ):
        mine.setdefault(unit, []).append(bool(row.correct))
    if max(map(len, mine.values())) < 2:
        return None
    return rate_interval(
        [sum(one) for one in mine.values()], [len(one) for one in mine.values()]
    )


def sweep(run: Path, told: dict[str, Any]) -> Counted:
    """Shares in all and by condition, how far away it is seen, drives, and the weighted
    share.
    """
    found = Counted()
    rows = rows_of(run)
    hidden = len(rows) - len(shown(rows))
    rows = shown(rows)

    def count(some: Sequence[Row]) -> tuple[int, int]:
        right = sum(bool(row.correct) for row in some)
        of = len(some)
        found.share(right, of, over_units(run, some))
        return right, of

    found.let(hidden, *count(rows))
    expected: dict[tuple[str, str], tuple[int, int]] = {}
    for one in told["conditions"]:
        low, _, high = one["value"].partition(" to ")
        found.let(one["value"])

        def inside(
            row: Row, axis: str = one["axis"], low: str = low, high: str = high
        ) -> bool:
            value = row.values[axis]["value"]
            if isinstance(value, str):
                return value == low
            number = float(str(value))
            return (
                float(low) <= number < float(high)
                if high
                else math.isclose(number, float(low), rel_tol=1e-3)
            )

        expected[one["axis"], one["value"]] = count(
            [row for row in rows if inside(row)]
        )
        # ends of parts are written with four digits, so a row at an end may stand in
        # the next part
        if not high:
            assert (one["right"], one["of"]) == expected[one["axis"], one["value"]], one
        found.share(one["right"], one["of"], tuple(one["interval"])) if high else None
    distances = {
        value: both
        for (axis, value), both in expected.items()
        if axis == "camera.distance"
    }
    if len(distances) > 1:
        seen_from(found, distances)
    if "answer" in rows[0].values:
        points = pairs_in(found, rows_of(run))
        found.let(*(f"{abs(100 * one):.0f}" for one in points))
    if "path.time" in rows[0].values:
        drives(found, run, rows_of(run))
    places = {
        value: both for (axis, value), both in expected.items() if axis == "environment"
    }
    common = yaml.safe_load((run.parent / "common.yaml").read_text())["environment"]
    found.let(len(places))
    if len(places) == len(common):
        weigh(found, places, common)
    return found


def seen_from(found: Counted, counts: dict[str, tuple[int, int]]) -> None:
    """From how far away it is seen: each share against one half by the binomial test,
    all together at 95 %.
    """
    at = sorted(counts, key=float)
    each = 0.025 / len(at)
    for value in at:
        right, of = counts[value]
        if (
            binom.sf(right - 1, of, 0.5) < each
            or binom.sf(of - right - 1, of, 0.5) < each
        ):
            found.let(format_number(float(value)))
    falling = np.array([counts[value][0] / counts[value][1] for value in at])
    weights = np.array([counts[value][1] for value in at], dtype=float)
    from sklearn.isotonic import IsotonicRegression

    fitted = IsotonicRegression(increasing=False).fit_transform(
        np.arange(len(at)), falling, sample_weight=weights
    )
    for k in range(len(at) - 1):
        if fitted[k] >= 0.5 > fitted[k + 1]:
            share = (fitted[k] - 0.5) / (fitted[k] - fitted[k + 1])
            # on a logarithmic axis
            found.let(
                f"{float(at[k]) ** (1.0 - share) * float(at[k + 1]) ** share:.3g}"
            )


def drives(found: Counted, run: Path, rows: Sequence[Row]) -> None:
    """What is said of whole drives: shares, gaps, the first right distance and changes,
    each with the worst. Frames without the object are no gap, and no change is counted
    from or to one.
    """
    with Store(run / "results.sqlite", read_only=True) as store:
        units = read_units(store)
    assert units is not None
    each: dict[int, list[tuple[float, float, str]]] = {}
    for row, unit in zip(
        rows,
        units.find_unit(np.array([one.step for one in rows])).tolist(),
        strict=True,
    ):
        time, away = (
            float(str(row.values[f"path.{name}"]["value"]))
            for name in ("time", "distance")
        )
        each.setdefault(unit, []).append(
            (time, away, "rw"[not row.correct] if shown([row]) else " ")
        )
    frames = [
        sorted(one) for one in each.values() if any(what != " " for _, _, what in one)
    ]
    times = [time for time, _, _ in frames[0]]
    seconds = times[-1] - times[0]
    step = seconds / (len(times) - 1)
    found.let(len(frames), len(times), f"{seconds:g}")
    said = ["".join(what for _, _, what in one) for one in frames]
    gaps = [step * max(map(len, re.findall("w+", one)), default=0.0) for one in said]
    first = [
        next((away for _, away, what in one if what == "r"), None) for one in frames
    ]
    seen = [one for one in first if one is not None]
    changes = [
        sum(a + b in ("rw", "wr") for a, b in itertools.pairwise(one)) / seconds
        for one in said
    ]
    distances = [distance for one in frames for _, distance, _ in one]
    shares = [one.count("r") / len(one.replace(" ", "")) for one in said]
    sides: list[tuple[list[float], Interval, Any]] = [
        (shares, (0.0, 1.0), min), (gaps, (0.0, len(times) * step), max), (seen, (min(distances), max(distances)), min),
        (changes, (0.0, (len(times) - 1) / seconds), max),
    ]  # fmt: skip
    for values, (low, high), worst in sides:
        if not values:
            continue
        for value in (
            sum(values) / len(values),
            worst(values),
            *mean_interval(values, low, high),
        ):
            found.let(f"{value:.3g}", f"{100 * value:.3g}")
    found.let(len(frames) - len(seen))


def weigh(
    found: Counted, counts: dict[str, tuple[int, int]], common: dict[str, float]
) -> None:
    """The weighted share, between the weighted ends of intervals that hold together."""
    total = sum(common.values())
    sure = 1.0 - 0.05 / len(common)
    shares = [(common[name] / total, counts[name]) for name in common]
    mean = sum(part * right / of for part, (right, of) in shares)
    ends = [
        sum(part * exact(right, of, sure)[end] for part, (right, of) in shares)
        for end in (0, 1)
    ]
    found.let(
        percent(mean),
        format_interval((ends[0], ends[1])),
        *(percent(part) for part, _ in shares),
    )


def explain(run: Path, told: dict[str, Any]) -> Counted:
    """Each rule: its fresh renders, and the rows of the half that did not choose."""
    from advsearch.questions.explain.rows import read_predictions
    from advsearch.questions.sweep.stored import StoredSweep
    from advsearch.rules import make_table, split_in_halves

    found = Counted()
    summary = json.loads((run / "summary.json").read_text())
    rows = read_predictions(
        [StoredSweep.read(Path(name)) for name in summary["sweeps"]]
    )
    rows = rows[rows["label"] != "out of view"].reset_index(drop=True)
    _, left = split_in_halves(make_table(rows, rows.attrs["units"]), 0)
    before: list[list[dict[str, Any]]] = []
    for number, rule in enumerate(summary["rules"], 1):
        found.let(number, *(one["text"] for one in rule["conditions"]))
        holds = np.array(
            [covers(rule["conditions"], one) for one in left.to_dict("records")],
            dtype=bool,
        )
        for part in (left[holds], left[~holds]):
            found.share(int(part["correct"].sum()), len(part))
        fresh = [
            row
            for part in sorted((run / "parts").glob(f"rule-{number}-*"))
            for row in shown(rows_of(part))
        ]
        inside = [row for row in fresh if covers(rule["conditions"], values(row))
                  and not any(covers(one, values(row)) for one in before)]  # fmt: skip
        if inside:
            found.share(sum(bool(row.correct) for row in inside), len(inside))
        before.append(rule["conditions"])
        left = left[~holds]
    envelope = summary["envelope"]
    if envelope:
        found.let(
            *(one["text"] for one in envelope["conditions"]),
            percent(envelope["accuracy"]),
        )
        found.share(envelope["right"], envelope["of"])
    return found


def values(row: Row) -> dict[str, Any]:
    return {name: one["value"] for name, one in row.values.items()}


def covers(conditions: Sequence[dict[str, Any]], row: dict[str, Any]) -> bool:
    """Whether a row lies under all conditions of a rule."""
    for one in conditions:
        value = row.get(one["parameter"])
        if one["options"]:
            if value not in one["options"]:
                return False
            continue
        low = one["over"] if one["over"] is not None else -math.inf
        high = one["at_most"]
        high = math.inf if high is None else high
        number = (
            float(str(value)) % one["turn"] if one.get("turn") else float(str(value))
        )
        if not (number > low or number <= high if low > high else low < number <= high):
            return False
    return True


def attack(run: Path, told: dict[str, Any]) -> Counted:
    """Trials of what was found."""
    found = Counted()
    with Store(run / "results.sqlite", read_only=True) as store:
        kinds = {
            kind: list(store.rows(kind))
            for kind in ("verification", "control", "baseline-verification")
        }
    summary = json.loads((run / "summary.json").read_text())
    trials = kinds["verification"]
    found.share(sum(bool(row.success) for row in trials), len(trials))
    for group in ("verified", "clean"):
        rated = (
            summary[group].get("control", summary[group]) if summary[group] else None
        )
        if rated:
            found.let(rated["trials"])
    found.let(
        summary["steps"] if "steps" in summary else "", *summary["renders"].values()
    )
    return found


def pairs_in(
    found: Counted, rows: Sequence[Row]
) -> tuple[float, float, float, int, int]:
    """Count the pairs of the clean object and the painted one; return the difference
    with Newcombe's interval, and how many pairs only the first and only the second has
    right.
    """
    half = len(rows) // 2
    pairs = [(bool(a.correct), bool(b.correct)) for a, b in zip(rows[:half], rows[half:], strict=True)
             if len(shown([a, b])) == 2]  # fmt: skip
    both, first, second, neither = (
        pairs.count((a, b)) for a, b in itertools.product((True, False), repeat=2)
    )
    difference, ends = newcombe(both, first, second, neither)
    for right in (both + first, both + second):
        found.share(right, len(pairs))
    found.let(len(pairs), first, second)
    return difference, *ends, first, second


def compare(run: Path, told: dict[str, Any]) -> Counted:
    """The pairs of the clean object and the painted one, with Newcombe's interval and
    McNemar's test.
    """
    found = Counted()
    points = pairs_in(found, rows_of(run.parent / "beside"))
    found.let(*(f"{100 * one:+.1f}" for one in points[:3]))
    first, second = points[3:]
    p = binomtest(first, first + second).pvalue if first + second else 1.0
    found.let(f"{p:.2g}", f"{p:.4f}", f"{p:.3f}", "0.0001")
    return found


def gate(run: Path, told: dict[str, Any]) -> Counted:
    """Each claim: its pictures, and the confidence sequence over them."""
    found = Counted()
    summary = json.loads((run / "summary.json").read_text())
    for one in summary["claims"]:
        rows = rows_of(run, f"claim {one['name']}")
        seen = shown(rows)
        sequence = ConfidenceSequence(summary["confidence"], sides=1)
        for row in seen:
            sequence.add(float(bool(row.correct)))
        found.share(
            sum(bool(row.correct) for row in seen), len(seen), sequence.interval
        )
        found.let(
            one["statement"],
            len(rows) - len(seen),
            len(seen),
            percent(summary["confidence"]),
        )
        for row in rows:
            for value in values(row).values():
                found.let(
                    *(format_number(value), f"{value:.4g}")
                    if isinstance(value, float)
                    else ()
                )
    return found


READERS: dict[str, Callable[[Path, dict[str, Any]], Counted]] = {
    "sweep": sweep, "explain": explain, "attack": attack, "compare": compare, "test": gate,
}  # fmt: skip


# ---- line by line
# ---------------------------------------------------------------------------


def sections(text: str) -> Iterator[tuple[str, list[str]]]:
    """Each run's lines of the Markdown, by its name: its claims, its table, and what
    stands under the headings that tell shares.
    """
    for part in text.split("\n## ")[1:]:
        name, _, rest = part.partition("\n")
        if name == "How to read this":
            return
        wanted = True
        lines = []
        for line in rest.splitlines():
            if line.endswith(":") and not line.startswith("-"):
                wanted = line.rstrip(":") in (
                    "Criterion",
                    "Triggering conditions",
                    "Exposure",
                )
            elif (
                wanted
                and line
                and not line.startswith(
                    ("| condition", "| ---", "![", "```", "advsearch ")
                )
            ):
                lines.append(line.replace("\\", ""))
        yield Path(name.replace("\\", "")).name, lines


def verdict_counts(
    conditions: Sequence[dict[str, Any]], criterion: float
) -> tuple[int, int, int, int]:
    """Count the conditions that meet a criterion, that fall short of it, that are open,
    and all.
    """
    met = sum(one["interval"][0] >= criterion for one in conditions)
    short = sum(one["interval"][1] < criterion for one in conditions)
    return met, short, len(conditions) - met - short, len(conditions)


def check(out: Path) -> int:
    """Print each line with what is not in the rows; return how many lines have
    something.
    """
    evidence = json.loads((out / "card" / "evidence.json").read_text())
    text = (out / "card" / "evidence.md").read_text()
    told = {Path(one["run"]).name: one for one in evidence["runs"]}
    asked = percent(evidence["criterion"])
    bad = lines = shares = 0
    for name, said in sections(text):
        counted = READERS[told[name]["command"]](out / name, told[name])
        counted.let(
            asked,
            *verdict_counts(told[name].get("conditions", []), evidence["criterion"]),
        )
        for line in said:
            lines += 1
            numbers = {
                one.lstrip("+-")
                for one in NUMBER.findall(re.sub(r"(\d)-(\d)", r"\1 \2", line))
            }
            missing = sorted(numbers - counted.numbers)
            for right, of, ends in SHARE.findall(line):
                shares += 1
                known = [
                    one.replace("-", " to ")
                    for one in counted.shares.get((int(right), int(of)), [])
                ]
                if not any(ends.replace("-", " to ") in one for one in known):
                    missing.append(
                        f"{right} of {of} ({ends}; counted: "
                        f"{', '.join(known) or 'no such share'})"
                    )
            bad += bool(missing)
            if missing:
                print(f"{name}: {line}\n    not in the rows: {', '.join(missing)}")
    print(
        f"{lines} lines of {len(told)} runs, {shares} shares with intervals: {bad} "
        "lines are not what the rows say"
    )
    return bad


if __name__ == "__main__":
    main()
