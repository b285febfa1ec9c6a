"""Rewrites what is made from the code, or from the reference model's record, in the
pages of this folder.

    python docs/make_figures.py [--check]

A made part stands between two comments, `<!-- made by docs/make_figures.py: NAME -->`
and `<!-- end of NAME -->`; all else in a page is written by hand. `--check` writes
nothing, names the files that differ and exits 3. Also drawn here:
`docs/images/reliability.svg`, once the reference model has been measured.
"""

from __future__ import annotations

import argparse
import inspect
import json
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

from pydantic.fields import ComputedFieldInfo, FieldInfo

from advsearch.cli.flags import SCENE_HELP, format_help
from advsearch.cli.main import add_command
from advsearch.config import CONFIGS
from advsearch.controls import CONTROLS
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.summary import AttackSummary, CurveResult, MatrixResult
from advsearch.questions.compare.result import CompareResult
from advsearch.questions.explain.result import ExplainResult
from advsearch.questions.harden.result import HardenResult
from advsearch.questions.recipe.description import list_recipes as recipe_names
from advsearch.questions.region.result import RegionResult
from advsearch.questions.replay.result import ReplayResult
from advsearch.questions.stability.result import CaseRow
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.questions.test.result import SuiteResult
from advsearch.questions.twins.result import TwinsResult
from advsearch.runs.results import (
    CleanScene,
    Fields,
    Formation,
    LinearTransport,
    Result,
    SceneResult,
    SharedWork,
    StudyResult,
    VariedValue,
    VerifiedRate,
)
from advsearch.scene.settings import SETTINGS
from advsearch.settings import Setting, settings

DOCS = Path(__file__).resolve().parent
DIAGRAM = "images/reliability.svg"

Record = Mapping[str, Any]
"""What `tools/reference_model.py` keeps in reference.json, or a part of that."""


def main(argv: Sequence[str] | None = None) -> int:
    """Rewrite or check every file; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--check",
        action="store_true",
        help="write nothing; exit 3 if a file is not as it should be",
    )
    check = parser.parse_args(argv).check
    try:
        wrong = differing()
    except ValueError as error:
        parser.exit(2, f"{error}\n")
    for path, text in wrong.items():
        print(
            f"{'differs' if check else 'written'}: {path.relative_to(DOCS.parent)}",
            file=sys.stderr,
        )
        if not check:
            path.write_text(text, encoding="utf-8")
    return 3 if check and wrong else 0


def differing(record: Record | None = None) -> dict[Path, str]:
    """Return the files whose made parts are not up to date, with the text that they
    should have.

    Args:
        record: of the reference model; None reads the package's own.
    """
    record = stored_record() if record is None else record
    wanted: dict[Path, str] = {}
    for (page, name), make in PARTS.items():
        path = DOCS / page
        try:
            wanted[path] = replaced(
                wanted.get(path) or path.read_text(encoding="utf-8"), name, make(record)
            )
        except ValueError as error:
            raise ValueError(f"docs/{page}: {error}") from None
    if measured(record):
        wanted[DOCS / DIAGRAM] = reliability_diagram(record["figures"]["heldout"])
    return {
        path: text
        for path, text in wanted.items()
        if not path.exists() or path.read_text("utf-8") != text
    }


def replaced(page: str, name: str, content: str) -> str:
    """Return the page with the content of one made part exchanged.

    Raises:
        ValueError: the page does not have that part exactly once.
    """
    begin = f"<!-- made by docs/make_figures.py: {name} -->\n"
    end = f"<!-- end of {name} -->"
    if page.count(begin) != 1 or page.count(end) != 1:
        raise ValueError(
            f"expected one part named {name!r}, two lines in the page: "
            f"{begin.strip()} and {end}"
        )
    before, rest = page.split(begin)
    return f"{before}{begin}{content}{end}{rest.split(end)[1]}"


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; a vertical bar in a cell is escaped."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n"
        for line in lines
    )


# ---- parts made from the code
# ---------------------------------------------------------------------------


def flags(record: Record) -> str:
    """Every flag of `attack` with its values and default, group by group."""
    parts = []
    for group in sorted(
        {one.group: None for one in settings(AttackConfig)},
        key=lambda group: group == "run",
    ):
        rows = [_flag_row(one) for one in settings(AttackConfig) if one.group == group]
        rows += [["`--scene`", SCENE_HELP, "", ""]] if group == "scene" else []
        parts.append(f"**{group.capitalize()}**\n\n" + table(FLAG_HEADS, rows))
    return "\n".join(parts)


FLAG_HEADS = ("flag", "what", "values", "default")


def own_flags(command: str) -> Callable[[Record], str]:
    """The flags of a command that differ from those of `attack`, as a table, and the
    names of those that do not.
    """

    def make(record: Record) -> str:
        known = [
            one for one in settings(CONFIGS[command]) if one.flag in flags_of(command)
        ]
        as_in_attack = settings(AttackConfig)
        shared = [f"`{one.flag}`" for one in known if one in as_in_attack]
        shared += ["`--scene`"] if "--scene" in flags_of(command) else []
        left_out = [
            f"`{one.flag}`" for one in as_in_attack if one.flag not in flags_of(command)
        ]
        few = len(left_out) < 4
        said = (
            f"All flags of `attack` but {', '.join(left_out)}"
            if few
            else f"As for `attack`: {', '.join(shared)}"
        )
        rows_of_attack = {one.flag: _flag_row(one) for one in as_in_attack}
        own = []
        other_defaults = []
        for one in known:
            if one in as_in_attack:
                continue
            row = _flag_row(one)
            same = (
                None
                if one.group in (command, "verification")
                else rows_of_attack.get(one.flag)
            )
            if same is not None and same[:3] == row[:3] and row[3]:
                other_defaults.append(f"{row[0]} ({row[3]})")
                continue
            if same is not None and row[2] and same[2] == row[2]:
                row[2] = "as for `attack`"
            own.append(row)
        if other_defaults:
            said += f". With another default: {', '.join(other_defaults)}"
        return _wrapped(f"{said}.") + ("\n" + table(FLAG_HEADS, own) if own else "")

    return make


def flags_of(command: str) -> set[str]:
    """Return the flags that a command takes, as its help shows them."""
    parser = add_command(argparse.ArgumentParser().add_subparsers(), command)
    return set(re.findall(r"^  (--[a-z][a-z-]*)", parser.format_help(), re.MULTILINE))


def _wrapped(text: str) -> str:
    return (
        "\n".join(
            textwrap.wrap(text, 119, break_long_words=False, break_on_hyphens=False)
        )
        + "\n"
    )


def _flag_row(one: Setting) -> list[str]:
    """A flag, what it is, its values and its default, cut from its help text."""
    text = format_help(one).replace("%%", "%")
    if one.is_switch:
        return [f"`{one.flag}`", text, "no value", ""]
    values, marked, default = text.removeprefix(f"{one.description}: ").partition(
        " (default: "
    )
    shown = "required" if one.required else default.removesuffix(")") if marked else ""
    return [f"`{one.flag}`", one.description, values, shown]


def scene_parameters(record: Record) -> str:
    """Every parameter that `--set` fixes."""
    rows = [
        [
            f"`{name}`",
            one.unit if one.unit != "1" else "",
            " or ".join(one.options) or f"{one.low:g} to {one.high:g}",
            one.default if isinstance(one.default, str) else f"{one.default:g}",
            one.description,
        ]
        for name, one in SETTINGS.items()
    ]
    return table(["parameter", "unit", "range", "default", "what"], rows)


def objects(record: Record) -> str:
    """The bundled objects with the labels that the reference model gives them."""
    from advsearch.questions.harden.objects import OBJECTS

    return table(
        ["object", "label"], [[f"`{one.name}`", one.label] for one in OBJECTS.values()]
    )


def environments(record: Record) -> str:
    """The bundled environments and the half that each belongs to."""
    from scenes.environments import ENVIRONMENTS

    half = {
        "train": "training",
        "heldout": "held out",
        "street": "a street, in neither",
        "place": "a place, in neither",
    }
    return table(
        ["environment", "half"],
        [[f"`{one.name}`", half[one.split]] for one in ENVIRONMENTS.values()],
    )


def controls(record: Record) -> str:
    """Every control with one sentence and its picture; below, in full, those that have
    no page.
    """

    rows = []
    below = ""
    for kind in CONTROLS.built_ins:
        place = f"{kind}.md" if (f"controls/{kind}.md", kind) in PARTS else f"#{kind}"
        drawn = (DOCS / "images" / "controls" / f"{kind}.png").is_file()
        picture = f"![{kind}](../images/controls/{kind}.png)" if drawn else ""
        rows.append([f"[{kind}]({place})", CONTROLS[kind].summary, picture])
        if place.startswith("#"):
            example = f"```sh\nadvsearch attack --object mug --control {kind}\n```\n"
            below += f"\n### {kind}\n\n{CONTROLS[kind].summary}\n\n{example}\n{control(kind)(record)}"
    return table(["control", "what may vary", "examples"], rows) + below


def _searched(parameter: Any) -> str:
    """The range that is searched when nothing is said."""
    if parameter.search is None:
        return "only if asked"
    if parameter.options:
        return "all"
    return f"{parameter.search[0]:g} to {parameter.search[1]:g}" + (
        ", logarithmic" if parameter.log else ""
    )


def _remarks(parameter: Any) -> str:
    """Estimators, and what the plan has to know."""
    said = ["none" if parameter.options else ", ".join(parameter.estimators)]
    said += ["periodic"] if parameter.periodic else []
    return "; ".join(said + (["moves outlines"] if parameter.moves_silhouettes else []))


def control(kind: str) -> Callable[[Record], str]:
    """The parameters and settings that a control declares."""

    def make(record: Record) -> str:

        declared = CONTROLS[kind]
        parameters = [
            [
                f"`{one.name}`",
                " x ".join("any" if side is None else str(side) for side in one.shape)
                or "number",
                one.unit,
                ", ".join(one.options)
                if one.options
                else f"{one.low:g} to {one.high:g}",
                _searched(one),
                f"{one.default:g}"
                if isinstance(one.default, float)
                else str(one.default),
                _remarks(one),
                one.description,
            ]
            for one in declared.parameters
        ]
        heads = [
            "parameter",
            "shape",
            "unit",
            "allowed",
            "searched",
            "default",
            "derivative",
            "what",
        ]
        if not parameters:
            return (
                "The scene names them: a wrong name is answered with those that "
                "are "
                "there."
            )
        choices = [
            [f"`{one.name}`", _shown(one.default), one.description]
            for one in declared.choices
        ]
        settings_table = (
            "\n" + table(["setting", "default", "what"], choices) if choices else ""
        )
        return table(heads, parameters) + settings_table

    return make


def policy(name: str) -> Callable[[Record], str]:
    """The options of a policy: the fields of its dataclass, with what its docstring
    says of them.
    """

    def make(record: Record) -> str:
        from advsearch.attacks import POLICIES

        known = POLICIES[name]
        said = inspect.getdoc(known) or ""
        rows = []
        for one in fields(known):  # type: ignore[arg-type]
            entry = re.search(
                rf"^    {one.name}: (.+(?:\n {{8}}.+)*)", said, re.MULTILINE
            )
            rows.append(
                [
                    f"`{one.name}`",
                    f"`{one.default}`",
                    " ".join(entry[1].split()) if entry else "",
                ]
            )
        return table(["option", "default", "what"], rows)

    return make


def endings(record: Record) -> str:
    """How a run can end."""
    from advsearch.attacks import Ending

    return table(
        ["`ending`", "meaning"], [[f"`{one.value}`", one.explanation] for one in Ending]
    )


def result_fields(kind: type[Fields]) -> Callable[[Record], str]:
    """The fields that a result has of its own, in the order in which they are
    written.
    """

    def make(record: Record) -> str:
        once = EVERYWHERE if issubclass(kind, Result) else ()
        told = {
            one.alias or name: _field(one)
            for name, one in kind.get_described_fields().items()
            if name not in once
        }
        return table(
            ["field", "holds"],
            [[f"`{name}`", text] for name, text in told.items() if text],
        )

    return make


ASKED = "environment controls object objects model policy objective".split()
EVERYWHERE = {
    **StudyResult.get_described_fields(),
    **SceneResult.get_described_fields(),
    "objective": None,
}
"""Fields that are told once for all results: ASKED, and those that say how the run
went.
"""
PARTS_OF_SEVERAL: dict[str, type[Fields]] = {
    "image_formation": Formation,
    "clean": CleanScene,
    "conditions": VariedValue,
    "verified": VerifiedRate,
    "transport": LinearTransport,
    "shared": SharedWork,
}
"""What is in fields of several results, by the name that most of these have; told
once.
"""


def every_result(record: Record) -> str:
    """The fields that all results have."""
    asked = ", ".join(f"`{name}`" for name in ("schema", "command", *ASKED))
    rows = [
        [f"`{name}`", _field(one)]
        for name, one in EVERYWHERE.items()
        if one is not None and name not in ASKED
    ]
    return (
        _wrapped(f"What was asked for, and of what: {asked}.")
        + "\n"
        + table(["field", "holds"], rows)
    )


def several_results(record: Record) -> str:
    """What is in fields of several results."""
    rows = [
        [f"`{name}`", f"{_first_sentence(kind)}: {_inside(kind)}"]
        for name, kind in PARTS_OF_SEVERAL.items()
    ]
    return table(["field", "holds"], rows)


def _field(field: FieldInfo | ComputedFieldInfo) -> str:
    """What a field holds: its description, and the fields of what is in it."""
    annotation = field.annotation if isinstance(field, FieldInfo) else field.return_type
    inside = [
        one
        for one in _types(annotation)
        if isinstance(one, type) and issubclass(one, Fields)
    ]
    text = field.description or (_first_sentence(inside[0]) if inside else "")
    return (
        f"{text}: {_inside(inside[0])}"
        if inside and inside[0] not in PARTS_OF_SEVERAL.values()
        else text
    )


def _inside(kind: type[Fields]) -> str:
    """The names of the fields of what is in a field; their descriptions are in the JSON
    schema.
    """
    return ", ".join(
        f"`{part.alias or name}`" for name, part in kind.model_fields.items()
    )


def _first_sentence(kind: type[Fields]) -> str:
    text = (kind.__doc__ or "").splitlines()[0].rstrip(".")
    return text[:1].lower() + text[1:]


def _types(annotation: Any) -> Iterator[Any]:
    """A type and what it is made of."""
    yield annotation
    for one in get_args(annotation):
        yield from _types(one)


def _shown(value: object) -> str:
    return (
        "chosen"
        if value is None
        else f"`{value:g}`"
        if isinstance(value, float)
        else f"`{value}`"
    )


# ---- the reference model
# ---------------------------------------------------------------------------


def stored_record() -> dict[str, Any]:
    """Return the record that lies beside the weights in the package; empty if the model
    has not been trained yet.
    """
    from advsearch.models.reference import METADATA, get_data_folder

    path = get_data_folder() / METADATA
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}


def measured(record: Record) -> bool:
    """Return whether the record holds the figures of the held-out pictures and of the
    default views.
    """
    return {"heldout", "default_views"} <= set(record.get("figures", {}))


def reference(record: Record) -> str:
    """The figures of the reference model: of its training, over all held-out pictures,
    and for each class.
    """
    if not measured(record):
        return (
            "The reference model has not been measured yet: run `make reference`, "
            "then this script.\n"
        )
    labels = record["labels"]
    figures = record["figures"]
    return (
        table(["figure", "value"], _overall(labels, figures, figures["heldout"]))
        + "\n![Reliability diagram: accuracy against confidence on the held-out "
        f"pictures]({DIAGRAM})\n\n"
        + table(
            ["class", "right, held out", "most often taken for", "default view"],
            _classes(labels, figures),
        )
    )


def _overall(
    labels: Sequence[str], figures: Record, heldout: Record
) -> list[list[str]]:
    from advsearch.models.reference import build
    from advsearch.statistics.intervals import clopper_pearson

    size = sum(parameter.numel() for parameter in build(len(labels)).parameters())
    count = heldout["count"]
    accuracy = heldout["accuracy"]
    low, high = clopper_pearson(round(accuracy * count), count)
    return [
        [
            "parameters",
            f"{size / 1e6:.2f} million ({4 * size / 1e6:.1f} MB in float32)",
        ],
        [
            "training pictures",
            f"{figures['pictures']:,}, seen {figures['epochs']} "
            f"times, seed {figures['seed']}",
        ],
        ["temperature", f"{figures['temperature']:.3f}, divided into the last layer"],
        ["held-out pictures", f"{count:,}"],
        [
            "right",
            f"{100 * accuracy:.1f} % (95 % interval {100 * low:.1f} to "
            f"{100 * high:.1f} %)",
        ],
        ["mean confidence", f"{100 * heldout['confidence']:.1f} %"],
        ["expected calibration error", f"{100 * heldout['error']:.1f} %"],
        ["log loss", f"{heldout['log_loss']:.3f} nats"],
    ]


def _classes(labels: Sequence[str], figures: Record) -> list[list[str]]:
    heldout = figures["heldout"]
    views = figures["default_views"]
    rows = []
    for index, label in enumerate(labels):
        right = heldout["per_class"][index]
        wrong = [
            0 if other == index else number
            for other, number in enumerate(heldout["confusion"][index])
        ]
        most = max(wrong)
        taken = f"{labels[wrong.index(most)]} ({most})" if most else "none"
        view = views.get(label.replace(" ", "-"))
        rows.append(
            [
                label,
                "" if right is None else f"{100 * right:.1f} %",
                taken,
                "" if view is None else f"{view:.3f}",
            ]
        )
    return rows


# ---- recipes
# ---------------------------------------------------------------------------

RECIPES = "images/recipes/results.json"


def recipe_results(record: Record) -> str:
    """What `docs/make_recipe_images.py` kept of each recipe: on other data, or else on
    bundled objects.
    """
    path = DOCS / RECIPES
    kept = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return "\n".join(
        _recipe(name, kept.get(name, {})) for name in sorted({*kept, *recipe_names()})
    )


def _recipe(name: str, found: Mapping[str, Any]) -> str:
    text = f"### {name}\n\n"
    for kind, how in (("data", "On real data"), ("bundled", "With `--quick`")):
        if kind in found:
            return text + _recipe_on(found[kind], how)
    return text + "Not run yet.\n"


def _recipe_on(told: Mapping[str, Any], how: str) -> str:
    what = ", ".join(f"`{one}`" for one in told["objects"])
    places = ", ".join(f"`{one}`" for one in told["environments"])
    models = ", ".join(f"`{one}`" for one in told["models"])
    took = f" in {told['seconds']} seconds" if "seconds" in told else ""
    took += (
        f", {told['cpu_seconds']} of processors"
        if told.get("cpu_seconds") is not None
        else ""
    )
    text = (
        _wrapped(
            f"**{how}**: {what} in {places}, seen by {models}; "
            f"{told['renders']} renders{took}."
        )
        + "\n"
    )
    for figure in told["figures"]:
        text += f"![{figure['title']}](images/recipes/{figure['image']})\n\n"
        text += _wrapped(f"*{figure['title']}.* " + figure["text"][0]) + "\n"
    return text


# ---- the reliability diagram: 100 units are a probability of 1
# ------------------------------------------------------

SIDE = 300
LEFT = 56
TOP = 16
COUNTS = 60
GAP = 22
INK = "#333333"
BAR = "#4477aa"
LINE = "#cc6677"


def reliability_diagram(heldout: Record) -> str:
    """Return the reliability diagram as SVG: accuracy of each confidence bin, and below
    how many pictures it holds.

    Args:
        heldout: a `calibration.Report` as it is stored: `bins`, `count`, `accuracy`, `error`.
    """
    width = LEFT + SIDE + 16
    height = TOP + SIDE + GAP + COUNTS + 44
    bottom = TOP + SIDE
    floor = TOP + SIDE + GAP + COUNTS
    most = max(one["count"] for one in heldout["bins"]) or 1
    shapes = [f'<rect width="{width}" height="{height}" fill="#ffffff"/>']
    for one in heldout["bins"]:
        x = LEFT + SIDE * one["low"]
        wide = SIDE * (one["high"] - one["low"])
        if one["count"]:
            shapes.append(_bar(x, bottom, wide, SIDE * one["accuracy"]))
            shapes.append(_bar(x, floor, wide, COUNTS * one["count"] / most))
    shapes += [_frame(TOP, SIDE), _frame(floor - COUNTS, COUNTS)]
    diagonal = f'<line x1="{LEFT}" y1="{bottom}" x2="{LEFT + SIDE}" y2="{TOP}"'
    shapes.append(
        f'{diagonal} stroke="{LINE}" stroke-width="2" stroke-dasharray="6 4"/>'
    )
    for tick in (0.0, 0.25, 0.5, 0.75, 1.0):
        shapes.append(_text(LEFT - 6, bottom - SIDE * tick + 4, f"{tick:g}", "end"))
        shapes.append(_text(LEFT + SIDE * tick, floor + 16, f"{tick:g}", "middle"))
    shapes += [
        _text(LEFT - 6, floor - COUNTS + 8, f"{most:,}", "end"),
        _text(LEFT + SIDE / 2, floor + 34, "confidence", "middle"),
        _text(14, TOP + SIDE / 2, "accuracy", "middle", turned=True),
        _text(14, floor - COUNTS / 2, "pictures", "middle", turned=True),
        _text(
            LEFT + 8,
            TOP + 18,
            f"calibration error {100 * heldout['error']:.1f} %",
            "start",
        ),
    ]
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}"'
    )
    return (
        f'{head} font-family="sans-serif" font-size="12">\n'
        + "\n".join(shapes)
        + "\n</svg>\n"
    )


def _bar(x: float, floor: float, wide: float, high: float) -> str:
    return (
        f'<rect x="{x:.2f}" y="{floor - high:.2f}" width="{wide:.2f}" '
        f'height="{high:.2f}" '
        f'fill="{BAR}" stroke="#ffffff"/>'
    )


def _frame(y: float, high: float) -> str:
    return (
        f'<rect x="{LEFT}" y="{y}" width="{SIDE}" height="{high}" fill="none" '
        f'stroke="{INK}"/>'
    )


def _text(x: float, y: float, text: str, anchor: str, *, turned: bool = False) -> str:
    turn = f' transform="rotate(-90 {x:.1f} {y:.1f})"' if turned else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" '
        f'fill="{INK}"{turn}>{text}</text>'
    )


PARTS: dict[tuple[str, str], Callable[[Record], str]] = {
    ("command-line.md", "flags"): flags,
    **{
        ("command-line.md", f"{command}-flags"): own_flags(command)
        for command in CONFIGS
        if command != "attack"
    },
    ("scenes.md", "parameters"): scene_parameters,
    ("scenes.md", "objects"): objects,
    ("scenes.md", "environments"): environments,
    ("controls/README.md", "controls"): controls,
    **{
        (f"controls/{kind}.md", kind): control(kind)
        for kind in CONTROLS.built_ins
        if (DOCS / "controls" / f"{kind}.md").is_file()
    },
    ("policies/pgd.md", "pgd"): policy("pgd"),
    ("design.md", "endings"): endings,
    ("results.md", "every-result"): every_result,
    ("results.md", "several-results"): several_results,
    ("results.md", "attack-fields"): result_fields(AttackSummary),
    ("results.md", "curve-fields"): result_fields(CurveResult),
    ("results.md", "matrix-fields"): result_fields(MatrixResult),
    ("results.md", "sweep-fields"): result_fields(SweepSummary),
    ("results.md", "region-fields"): result_fields(RegionResult),
    ("results.md", "replay-fields"): result_fields(ReplayResult),
    ("results.md", "explain-fields"): result_fields(ExplainResult),
    ("results.md", "compare-fields"): result_fields(CompareResult),
    ("results.md", "harden-fields"): result_fields(HardenResult),
    ("results.md", "test-fields"): result_fields(SuiteResult),
    ("results.md", "twins-fields"): result_fields(TwinsResult),
    ("stability.md", "case-fields"): result_fields(CaseRow),
    ("reference-model.md", "reference"): reference,
    ("recipe-results.md", "recipe-results"): recipe_results,
}
"""What makes each part of a page: (page, name of the part)."""


def parts_in(page: str) -> set[str]:
    """Return the names of the made parts of a page."""
    return set(re.findall(r"<!-- made by docs/make_figures\.py: ([\w-]+) -->", page))


if __name__ == "__main__":
    sys.exit(main())
