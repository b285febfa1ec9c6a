"""Hold pages, comments and lists to the code: python tools/check_docs.py

Everything that has a name is documented, made parts are up to date, numbers in the text
are those of the code, links and citations lead somewhere, and every file of tests has
quick ones. Prints one line for each mistake and exits 3 if there is one. What runs,
such as the commands of a page, is in tests/test_docs.py.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import fields
from functools import cache
from pathlib import Path
from types import ModuleType

import reference_scenes
import torch

from advsearch.attacks import (
    POLICIES,
    candidates,
    count_planned_renders,
    trials,
    verification,
)
from advsearch.attacks.objectives import OBJECTIVE_KINDS
from advsearch.attacks.policies import pgd
from advsearch.attacks.verification import WORST_CASE
from advsearch.cli.main import list_commands
from advsearch.cli.show import REGISTRIES
from advsearch.cluster.workers import CLUSTERS
from advsearch.controls import CONTROLS, texture
from advsearch.controls.support.norms import DEFAULT_EPSILON
from advsearch.engine.prediction import PREDICTORS
from advsearch.files import MESHES
from advsearch.models import loading, reference
from advsearch.models.loading import SOURCES as SOURCES_OF_MODELS
from advsearch.questions.attack import stages
from advsearch.questions.attack.settings import (
    MIN_TRIALS,
    TRIALS,
    TRIALS_OVER,
    AttackConfig,
)
from advsearch.questions.attack.summary import AttackSummary, CurveResult, MatrixResult
from advsearch.questions.region import boxes, growing
from advsearch.questions.region.result import RegionConfig
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.questions.test import counterexamples as tested
from advsearch.registry import EXPERIMENTS
from advsearch.runs import directory, export, store
from advsearch.runs.exporters import EXPORTERS
from advsearch.runs.results import RenderResult, Result
from advsearch.scene import formation, library
from advsearch.scene.geometry import FRAME_FILL
from advsearch.scene.importing.pictures import TEXTURE_LIMIT
from advsearch.scene.importing.readers import READERS
from advsearch.scene.mitsuba_backend import scene as mitsuba_scene
from advsearch.scene.settings import SETTINGS
from advsearch.settings import settings
from advsearch.statistics.intervals import CONFIDENCE, clopper_pearson
from advsearch.statistics.sequential import count_needed_samples

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted(DOCS.rglob("*.md")),
]
FOLDERS = ("advsearch", "benchmarks", "docs", "scenes", "tests", "tools")


def main() -> int:
    """Print every mistake; returns the exit status."""
    found = sorted({mistake for check in CHECKS for mistake in check()})
    for mistake in found:
        print(mistake, file=sys.stderr)
    return 3 if found else 0


@cache
def read(path: Path) -> str:
    """Return the text of a file."""
    return path.read_text("utf-8")


def page(name: str) -> str:
    """Return the text of a page of docs/."""
    return read(DOCS / name)


def name_of(path: Path) -> str:
    """Return a path from the repository's root."""
    return path.relative_to(ROOT).as_posix()


@cache
def script(name: str) -> ModuleType:
    """Import a script of docs/, which is no package."""
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def blocks(path: Path, language: str) -> Iterator[str]:
    """Yield the fenced blocks of one language, without their indentation."""
    for indent, body in re.findall(
        rf"^( *)```{language}\n(.*?)^ *```$", read(path), re.M | re.S
    ):
        yield re.sub(rf"^{indent}", "", body, flags=re.MULTILINE)


def absent(name: str, texts: Iterable[str], text: str | None = None) -> Iterator[str]:
    """Say which texts are not in a page, or in a part of it."""
    text = page(name) if text is None else text
    yield from (
        f"docs/{name}: expected {wanted.strip()}"
        for wanted in texts
        if wanted not in text
    )


# ---- everything that has a name is documented
# ---------------------------------------------------------------------------


def commands() -> Iterator[str]:
    """Every command has a section with an example and its flags; a sentence says which
    can be quiet.
    """
    text = page("command-line.md")
    quiet = set()
    for command in list_commands():
        section = re.search(rf"^## {command}\n(.*?)(?=^## |\Z)", text, re.M | re.S)
        flags = script("make_figures").flags_of(command)
        quiet |= {command} if "--quiet" in flags else set()
        known = flags - {"--json", "--quiet"}
        if section is not None and "All flags of `attack` but" in section[1]:
            known -= script("make_figures").flags_of("attack")
        wanted = [f"\nadvsearch {command}", *(f"`{flag}`" for flag in sorted(known))]
        yield from absent("command-line.md", wanted, section[1] if section else "")
    said = " ".join(text.split()).partition("also take `--quiet`")[2].partition(".")[0]
    if set(re.findall(r"`([a-z]+)`", said)) != quiet:
        yield (
            f"docs/command-line.md: expected {sorted(quiet)} as commands that take "
            "--quiet"
        )
    yield from absent(
        "command-line.md", [f"| `{one.flag}` |" for one in settings(AttackConfig)]
    )
    yield from absent("command-line.md", [f"`{kind}`" for kind in REGISTRIES])


def controls() -> Iterator[str]:
    """A page of a control has its parameters, its settings and an example; of controls
    without one these are made.
    """
    for kind, control in CONTROLS.items():
        if not (DOCS / "controls" / f"{kind}.md").exists():
            continue
        declared = [one.name for one in control.parameters] + [
            one.name for one in control.choices
        ]
        yield from absent(
            f"controls/{kind}.md",
            [f"--control {kind}", *(f"| `{name}` |" for name in declared)],
        )


def policies() -> Iterator[str]:
    """Every policy has a page or a row with an example, and its options in the row with
    their defaults.
    """
    overview = page("policies/README.md")
    for name, policy in POLICIES.items():
        own = (
            f"policies/{name}.md"
            if (DOCS / f"policies/{name}.md").exists()
            else "policies/README.md"
        )
        if f"--policy {name}" not in page(own):
            yield (
                f"docs/{own}: expected an example, such as advsearch attack "
                "--object "
                f"mug --policy {name}"
            )
        row = re.search(
            rf"^\| (?:`{name}`|\[`{name}`\]\({name}\.md\)) \|.*$",
            overview,
            re.MULTILINE,
        )
        if row is None:
            options = (
                ", ".join(
                    f"`{one.name}` (its range; {one.default})"
                    for one in fields(policy)  # type: ignore[arg-type]
                )
                or "none"
            )
            gradients = (
                "yes" if getattr(policy, "uses_gradient", True) is True else "no"
            )
            yield (
                f"docs/policies/README.md: expected a row, | `{name}` | what it does | "
                f"when to take it | {gradients} | "
                f"{options} |"
            )
            continue
        said = dict(
            re.findall(r"`([a-z0-9_]+)` \(([^)]*)\)", row[0].rpartition(" | ")[2])
        )
        declared = {one.name: one.default for one in fields(policy)}  # type: ignore[arg-type]
        if set(said) != set(declared):
            yield (
                f"docs/policies/README.md: expected the options {sorted(declared)} "
                f"of {name}, got {sorted(said)}"
            )
        for option in set(said) & set(declared):
            default = declared[option]
            if isinstance(default, (bool, int, float)):
                stated = re.split(
                    r"[:;,]\s*", said[option].rpartition("; ")[2] or said[option]
                )[0].strip("` ")
                wanted = (
                    str(default).lower()
                    if isinstance(default, bool)
                    else f"{default:g}"
                )
                if stated != wanted:
                    yield (
                        f"docs/policies/README.md: expected {wanted} as {name}'s "
                        f"{option}, got {stated}"
                    )


def names() -> Iterator[str]:
    """Objectives, scenes, options of models, targets, benchmarks and what a run holds
    are in their pages.
    """
    for name in OBJECTIVE_KINDS:
        yield from absent("objectives.md", [f"| `{name}` |", f"--objective {name}"])
    bundled = [*SETTINGS, *library.list_objects(), *library.list_environments()]
    yield from absent("scenes.md", [f"| `{name}` |" for name in bundled])
    yield from absent(
        "scenes.md",
        [f"`{ending}`" for ending in (*MESHES, *library.ENVIRONMENT_SUFFIXES)],
    )
    options = set(inspect.signature(loading.load_model).parameters) - {
        "spec",
        "name",
        "max_batch",
    }
    text = page("models.md")
    yield from (
        f"docs/models.md: expected {one}"
        for one in options
        if f"{one}=" not in text and f"`{one}`" not in text
    )
    text = page("development.md")
    for target in re.findall(r"^([a-z-]+):.*?## ", read(ROOT / "Makefile"), re.M):
        if f"`{target}`" not in text and f"make {target}" not in text:
            yield f"docs/development.md: expected the target {target}"
    yield from absent(
        "development.md",
        [f"| [`{path.name}`]" for path in (ROOT / "benchmarks").glob("[!_]*.py")],
    )


PLAIN = set(
    "object objects task environment controls model policy objective loss run ending "
    "depth specialised interrupted "
    "figures seconds seed spp goal renders_per_gradient".split()
)
"""Fields that say themselves."""


def results() -> Iterator[str]:
    """Fields of results say what they hold; columns and files of a run are in the page
    about runs.
    """
    kinds: list[type[Result]] = [
        AttackSummary,
        SweepSummary,
        CurveResult,
        MatrixResult,
        RenderResult,
    ]
    for kind in kinds:
        silent = {
            name
            for name, field in kind.get_described_fields().items()
            if not script("make_figures")._field(field)
        }
        if not (kind.__doc__ and kind.command) or silent - PLAIN:
            yield (
                f"{kind.__name__}: expected a docstring, a command and descriptions "
                f"of {sorted(silent - PLAIN)}"
            )
    text = page("runs.md")
    rows = re.findall(r"^\| (`.*?) \|", text, re.M)
    said = {name for row in rows for name in re.findall(r"`([a-z_]+)`", row)}
    yield from (
        f"docs/runs.md: expected a row of {name}"
        for name in {*export.LEADING_COLUMNS, *export.TRAILING_COLUMNS} - said
    )
    if {*export.LEADING_COLUMNS, *export.TRAILING_COLUMNS, "values", "metrics"} != {
        one.name for one in fields(store.Row)
    }:
        yield "advsearch/runs/export.py: expected every field of a row"
    yield from absent("runs.md", [f"`{format}`" for format in export.FORMATS])
    stems = [
        name.removesuffix("-journal").removesuffix("-wal").removesuffix("-shm")
        for name in directory.CONTENTS
    ]
    yield from absent(
        "runs.md", [f"`{stem}" for stem in stems], text.partition("## What survives")[0]
    )


# ---- what is made from the code is up to date
# ---------------------------------------------------------------------------


def made() -> Iterator[str]:
    """The made parts are there and up to date."""
    figures = script("make_figures")
    try:
        yield from (
            f"{name_of(path)}: run python docs/make_figures.py"
            for path in figures.differing()
        )
    except ValueError as error:
        yield str(error)
    wanted = [
        f"controls/{kind}.md"
        for kind in CONTROLS
        if (DOCS / "controls" / f"{kind}.md").exists()
    ]
    own = [name for name in POLICIES if (DOCS / "policies" / f"{name}.md").exists()]
    wanted += [
        f"policies/{name}.md"
        for name in own
        if inspect.signature(POLICIES[name]).parameters
    ]
    having = {name for name, _ in figures.PARTS}
    yield from (
        f"docs/make_figures.py: expected a part of {name}"
        for name in wanted
        if name not in having
    )
    for path in DOCS.rglob("*.md"):
        name = path.relative_to(DOCS).as_posix()
        if figures.parts_in(read(path)) != {
            part for known, part in figures.PARTS if known == name
        }:
            yield (
                f"docs/{name}: expected the parts that PARTS of "
                "docs/make_figures.py "
                "names"
            )
    shown = (
        read(PAGES[0])
        .partition("<!-- made by docs/make_images.py -->")[2]
        .partition("<!-- end -->")[0]
    )
    if "fresh renders" not in shown:
        yield "README.md: run python docs/make_images.py RUN"


def _looks() -> tuple[int, int, int]:
    """Trials that all have to succeed, and what is needed of how many else."""
    first, last = verification.TRIAL_LOOKS
    return (
        WORST_CASE.count_needed_successes(first),
        WORST_CASE.count_needed_successes(last),
        last,
    )


def _exceptions(samples: int) -> float:
    """The share of a box that may have another verdict, where all samples agree."""
    nothing = torch.zeros(1)
    return (
        1.0
        - boxes.GrownBox(nothing, nothing, nothing, samples, samples, samples).interval[
            0
        ]
    )


def _draws(mean: float, value: float = 1.0) -> int:
    """Pictures that decide a claim where all predictions are alike."""
    return count_needed_samples(mean, confidence=CONFIDENCE, value=value)


MADE_BY_HAND = [
    ("design.md", f"**First look**: {stages.N_FIRST_LOOKS} renders of the clean scene"),
    ("design.md", f"That makes `steps` + {count_planned_renders(0)} renders"),
    (
        "design.md",
        f"at {', '.join(map(str, trials.LADDER[:-1]))} and "
        f"{trials.LADDER[-1]} samples a pixel",
    ),
    (
        "design.md",
        "Looks are after {}, {} and {} renders".format(
            *trials.list_look_sizes(verification.TRIAL_LOOKS[0])
        ),
    ),
    ("design.md", f"{TRIALS_OVER} with `--over`, {TRIALS} with `--smallest`"),
    (
        "design.md",
        f"must reach {verification.PASS_PERCENT_OVER} % of the trials in "
        "which the clean scene is right",
    ),
    ("design.md", "rounded up: {0} of {0}, or {1} of {2}".format(*_looks())),
    (
        "design.md",
        "14 of 14 means a true rate of at least "
        f"{100 * clopper_pearson(14, 14)[0]:.0f} %",
    ),
    ("design.md", f"at most {mitsuba_scene.MAX_DEPTH} segments"),
    (
        "questions.md",
        {8: "Eight renders of the best configurations"}[count_planned_renders(0)],
    ),
    ("questions.md", f"**Verified** by {verification.TRIAL_LOOKS[0]} fresh renders"),
    (
        "questions.md",
        f"until they are within {100 * (candidates.RATIO - 1):.0f} % of each other",
    ),
    ("questions.md", {12: "or twelve searches are done"}[candidates.MAX_SEARCHES]),
    (
        "questions.md",
        f"Each step needs {MIN_TRIALS} trials without a failure, or {TRIALS} trials "
        "after one failure",
    ),
    ("questions.md", f"**Verified** on up to {TRIALS_OVER} conditions"),
    ("questions.md", f"needs {verification.PASS_PERCENT_OVER} % of those that count"),
    ("questions.md", {8: "in one to eight parameters"}[growing.MAX_PARAMETERS]),
    ("questions.md", {8: "as long as eight random pictures"}[boxes.PROBES]),
    ("questions.md", {4: "with other seeds, up to four times"}[boxes.ATTEMPTS]),
    ("questions.md", f"First come {growing.CENTER_TRIALS} trials of the centre"),
    (
        "questions.md",
        f"Then come {RegionConfig.model_fields['samples'].default} fresh samples",
    ),
    (
        "questions.md",
        f"at most {100 * _exceptions(200):.1f} % of the box has another verdict",
    ),
    (
        "testing.md",
        "takes {} of them, *at least 0.99* {}, and".format(*map(_draws, (0.95, 0.99))),
    ),
    (
        "testing.md",
        f"*no worse by 5 points* {_draws(0.475, 0.5)} where both models predict alike",
    ),
    (
        "testing.md",
        "in all {} trials ({} for one".format(
            *(tested.count_trials(has_conditions=over) for over in (False, True))
        ),
    ),
    (
        "testing.md",
        f"6 of 6 show a share of at least {100 * clopper_pearson(6, 6)[0]:.0f} %",
    ),
    (
        "design.md",
        f"are rendered under {trials.N_CONDITIONS} conditions at 4, 16 and 64 samples",
    ),
    (
        "design.md",
        f"carry at most {100 * trials.MAX_MOVED_FRACTION:.0f} % of the conditions over "
        "zero",
    ),
    ("runs.md", {1.0: "may lose the rows of the last second"}[store.SYNC_INTERVAL]),
    ("runs.md", f"more than {100 * store.SYNC_SHARE:.0f} % of the time"),
    ("scenes.md", f"reaches to {100 * FRAME_FILL:.0f} % of the way"),
    ("scenes.md", f"gets the linear value {formation.CARD_DISPLAY_VALUE}"),
    ("scenes.md", f"averaged down to at most {TEXTURE_LIMIT} texels"),
    ("scenes.md", "Maps larger than {1} x {0} are".format(*library.MAX_MAP_SIZE)),
    ("controls/texture.md", f"Default {DEFAULT_EPSILON}"),
    ("controls/texture.md", "at least {} and at most {}".format(*texture.RESOLUTIONS)),
    ("policies/pgd.md", f"the first after {100 * pgd.FIRST_WINDOW:.0f} % of the steps"),
    (
        "policies/pgd.md",
        {0.75: "fewer than three quarters of the steps"}[pgd.MIN_IMPROVING_FRACTION],
    ),
    ("policies/pgd.md", {5: "Five in a row end the search"}[pgd.MAX_FLAT_GRADIENTS]),
    (
        "reference-model.md",
        {0.25: "A quarter of the pictures is not denoised"}[reference_scenes.RAW_SHARE],
    ),
    ("reference-model.md", "pictures of {} x {} pixels".format(*reference.INPUT_SIZE)),
    ("models.md", "goes in as {} x {}, RGB".format(*loading.DEFAULT_INPUT_SIZE)),
]


def numbers() -> Iterator[str]:
    """Numbers in the text are those of the code."""
    for name, sentence in MADE_BY_HAND:
        yield from absent(name, [sentence], " ".join(page(name).split()))


# ---- links and words
# ---------------------------------------------------------------------------


def prose(path: Path) -> str:
    """Return a page without its code, fenced and inline."""
    text = re.sub(r"^ *```.*?^ *```$", "", read(path), flags=re.M | re.S)
    return re.sub(r"`[^`\n]*`", "code", text)


def anchors(path: Path) -> set[str]:
    """Return what `#...` may name in a page: headings that GitHub and MkDocs spell alike."""
    headings = re.findall(r"^#+ (.*)$", read(path), re.M)
    on_github = {
        re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        for heading in headings
    }
    return {anchor for anchor in on_github if "--" not in anchor}


def links() -> Iterator[str]:
    """Every relative link leads somewhere, and every page can be reached from the
    readme.
    """
    reached: dict[Path, set[Path]] = {}
    for path in PAGES:
        reached[path] = set()
        for target in re.findall(r"\]\(([^)\s]+)\)", prose(path)):
            name, _, anchor = target.partition("#")
            if name.startswith(("http://", "https://")):
                continue
            found = (path.parent / name).resolve() if name else path
            if not found.exists() or (anchor and anchor not in anchors(found)):
                yield f"{name_of(path)}: the link {target} leads nowhere"
            reached[path].add(found)
    seen = set[Path]()
    todo = [PAGES[0]]
    while todo:
        path = todo.pop()
        if path in reached and path not in seen:
            seen.add(path)
            todo += reached[path]
    yield from (f"{name_of(path)}: no link leads here" for path in set(PAGES) - seen)


def words() -> Iterator[str]:
    """Words are British, and no path of one machine is left."""
    for path in PAGES:
        found = re.findall(
            r"\b\w*(?:color|normaliz|recogniz|gray|behavior)\w*", prose(path), re.I
        )
        found += re.findall(r"/(?:work|tmp|home|root)/|\.\./shared", read(path))
        yield from (f"{name_of(path)}: unexpected {word}" for word in found)


# ---- citations
# ---------------------------------------------------------------------------

MADE_UP = {"tests/test_architecture.py", "tests/test_docs.py", "tests/test_registry.py"}
"""Tests of such rules, which name modules that are not there."""
NAME = re.compile(r"(?<![\w./-])`?(advsearch(?:\.[A-Za-z_]\w*)+)(?:\(\))?`?(?![\w/-])")
REGISTERED = (
    CLUSTERS,
    CONTROLS,
    EXPERIMENTS,
    EXPORTERS,
    OBJECTIVE_KINDS,
    POLICIES,
    PREDICTORS,
    READERS,
    SOURCES_OF_MODELS,
)
GROUPS = {registry.group for registry in REGISTERED}
"""Groups of entry points, which are names and no modules."""
PATH = re.compile(
    rf"(?<![\w./-])((?:{'|'.join(FOLDERS)})/[\w./-]*\w\.(?:py|md|sh|json|png))"
)
PLACEHOLDER = re.compile(r"\b[A-Z]{4,}\.")
HEADING = re.compile(r'(docs/[\w/-]+\.md),\s+"([^"]+)"')
ELSEWHERE = re.compile(r"\bDESIGN\b")
"""How a text outside the repository was cited."""


def citations() -> Iterator[str]:
    """What code, comments and pages cite is there: modules and what is in them, files,
    pages and their headings.
    """
    written = [
        path
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".md", ".py", ".sh")
    ]
    for path in [ROOT / "Makefile", *ROOT.glob("*.md"), *written]:
        if name_of(path) not in MADE_UP:
            yield from (
                f"{name_of(path)}: {cited} is not there"
                for cited in lost_in(read(path))
            )


def lost_in(text: str) -> list[str]:
    """Return what a text cites and is not there."""
    lost = [
        name for name in NAME.findall(text) if name not in GROUPS and not is_there(name)
    ]
    lost += [
        path
        for path in PATH.findall(text)
        if not PLACEHOLDER.search(path) and not (ROOT / path).exists()
    ]
    for path, heading in HEADING.findall(" ".join(text.split())):
        titles = (
            re.findall(r"^#+ (.*)$", read(ROOT / path), re.M)
            if (ROOT / path).exists()
            else []
        )
        lost += [f'{path}, "{heading}"'] * (heading not in titles)
    return lost + ELSEWHERE.findall(text)


@cache
def is_there(name: str) -> bool:
    """Whether a dotted name is a module, or something in one."""
    parts = name.split(".")
    found = importlib.import_module(parts[0])
    for number, part in enumerate(parts[1:], start=2):
        if not hasattr(found, part):
            if (
                not hasattr(found, "__path__")
                or importlib.util.find_spec(".".join(parts[:number])) is None
            ):
                return False
            importlib.import_module(".".join(parts[:number]))
        found = getattr(found, part)
    return True


CHECKS = (
    commands,
    controls,
    policies,
    names,
    results,
    made,
    numbers,
    links,
    words,
    citations,
)

if __name__ == "__main__":
    sys.exit(main())
