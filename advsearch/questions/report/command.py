"""`advsearch report`: runs as evidence for a model card or a safety case."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from advsearch import __version__
from advsearch.cli import output
from advsearch.errors import AdvsearchError, InputError
from advsearch.options import FROM_RUN

if TYPE_CHECKING:
    from advsearch.questions.report.answer import Evidence, EvidenceRun
    from advsearch.report.shown import Claim

HELP = "write what runs show, and no more than that, for a model card or a safety case"
MORE = ": a page, Markdown and JSON"
EXAMPLES = (
    "report mug-texture-001 mug-sweep-001 --evidence",
    "report mug-texture-001 mug-sweep-001 --evidence --out card --json",
)
NAME = "evidence"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("runs", nargs="+", metavar="RUN", help="names or folders of runs; of a recipe, its parts")
    parser.add_argument("--evidence", action="store_true", help="claims with what a reader needs to judge them")
    parser.add_argument("--out", metavar="FOLDER", help="where the three files go (default: %(default)s)", default=NAME)
    parser.add_argument("--overwrite", action="store_true", help="replace what is there")
    output.add_flags(parser)


def run(args: argparse.Namespace) -> int:
    """Write the files."""
    # late, so that --help answers at once
    from advsearch.questions.report.evidence import evidence_page, markdown
    from advsearch.runs.files import write_text
    from advsearch.runs.summary import to_json

    if not args.evidence:
        raise InputError("--evidence: say what to write; it is the one report of several runs, each has a page already")
    folder = Path(args.out)
    names = [folder / f"{NAME}.{suffix}" for suffix in ("html", "md", "json")]
    there = [one for one in names if one.exists()]
    if there and not args.overwrite:
        raise InputError(f"{there[0]}: exists already; add --overwrite or choose another folder with --out")
    evidence = collected(args.runs)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out: cannot make the folder {folder}: {error.strerror}") from None
    texts = (evidence_page(evidence), markdown(evidence), to_json(evidence) + "\n")
    for path, text in zip(names, texts, strict=True):
        write_text(path, text)
    if args.json:
        output.print_json(evidence)
        return 0
    for one in evidence.runs:
        print("\n".join([one.run, *(f"  {claim.kind}: {claim.statement}" for claim in one.claims)]))
    print("".join(f"\nNote: {text}" for text in evidence.warnings))
    print("\n".join(map(str, names)))
    return 0


def collected(runs: list[str]) -> Evidence:
    """Return runs as evidence.

    Raises:
        UnknownNameError: there is no such run.
        FileFormatError: what is kept of a run is something else.
    """
    # late, so that --help answers at once
    from advsearch.questions.report.answer import Evidence
    from advsearch.questions.report.evidence import RULES, warnings_over
    from advsearch.runs.directory import find_run

    folders = {part.resolve(): part for name in runs for part in _with_parts(find_run(name))}
    found = [_run(folder) for folder in folders.values()]
    models = [one.about.get("Model", "") for one in found]
    digests = [" ".join(text for name, text in one.made_with.items() if name in _files(model))
               for one, model in zip(found, models, strict=True)]  # fmt: skip
    warnings = warnings_over([one for one in models if one], [d for d, m in zip(digests, models, strict=True) if m])
    return Evidence(runs=found, warnings=warnings, rules=list(RULES), version=__version__)


def _files(model: str) -> list[str]:
    return [model, model.rpartition("@")[2]]


def _with_parts(folder: Path) -> Iterator[Path]:
    """A run; in place of a recipe, the runs that it consists of."""
    # late, so that --help answers at once
    from advsearch.runs.directory import PARTS, is_run

    parts = [one for one in sorted((folder / PARTS).glob("*")) if is_run(one)]
    if parts and _settings(folder).get("command") == "recipe":
        yield from parts
    else:
        yield folder


def _of_quick_recipe(folder: Path) -> bool:
    """Whether a run is a part of a recipe that was made with `quick`."""
    outer = _settings(folder.resolve().parent.parent)
    return outer.get("command") == "recipe" and outer.get("quick") is True


def _settings(folder: Path) -> Mapping[str, object]:
    """What its run.yaml says; nothing where there is none that can be read."""
    # late, so that --help answers at once
    from advsearch.runs.directory import CONFIG
    from advsearch.settings import read_yaml

    with suppress(AdvsearchError):
        return read_yaml(folder / CONFIG)
    return {}


def _run(folder: Path) -> EvidenceRun:
    """One run; of one that has no summary, that it claims nothing."""
    # late, so that --help answers at once
    from advsearch.questions.report.answer import EvidenceRun
    from advsearch.questions.report.evidence import NOT_NOTED, QUICK, claims_of, evidence_of
    from advsearch.report.shown import nothing_claimed
    from advsearch.runs.directory import CONFIG, typed_name
    from advsearch.runs.summary import NAME as SUMMARY
    from advsearch.runs.summary import read_result

    name, settings = typed_name(folder), _settings(folder)
    made = _made_with(folder)
    if not (folder / SUMMARY).is_file():
        facts = {"Object": str(settings.get("object") or ""), "Model": str(settings.get("model") or "")}
        return EvidenceRun(
            run=name,
            command=str(settings.get("command") or "unknown"),
            ending="none yet",
            claims=[nothing_claimed("the run has no result; it is at work, or was stopped before its end")],
            about={key: text for key, text in facts.items() if text},
            searched=[],
            measured={},
            excluded=["The run carries no claim; it is listed so that it is not left out unseen."],
            cost={},
            made_with=made or {"versions and files": NOT_NOTED},
            command_line=f"advsearch run {folder / CONFIG}",
        )
    result = read_result(folder)
    found = evidence_of(name, result, [*claims_of(result), *_photos(folder)], settings, made, _judged_by(settings))
    few = [QUICK] if _of_quick_recipe(folder) else []
    return found.model_copy(update={"excluded": [*few, *found.excluded]})


def _judged_by(settings: Mapping[str, object]) -> dict[str, object]:
    """The options of the task that a run was judged by; nothing of one that is not to be had here."""
    # late, so that --help answers at once
    from advsearch.tasks import make_task
    from advsearch.tasks.together import Together

    given: Any = settings.get("task")
    if given is None:
        return {}
    with suppress(AdvsearchError):
        task = make_task(given)
        alone = [("", task)] if not isinstance(task, Together) else [(f"{one.name}.", one) for one in task.parts]
        return {
            f"{of}{option.name}": getattr(one, option.name)
            for of, one in alone
            for option in fields(one)
            if option.metadata != FROM_RUN
        }
    return {}


def _photos(folder: Path) -> list[Claim]:
    # late, so that --help answers at once
    from advsearch.cli.show import photos_of
    from advsearch.questions.report.evidence import photo_claims

    photos = photos_of(folder)
    return photo_claims(photos) if photos else []


def _made_with(folder: Path) -> dict[str, str]:
    """What the run noted at each sitting; of several that differ, all."""
    # late, so that --help answers at once
    from advsearch.runs.made_with import NOTE
    from advsearch.runs.store import NAME as STORE
    from advsearch.runs.store import Store

    try:
        with Store(folder / STORE, read_only=True) as store:
            noted: Any = json.loads(store.note(NOTE) or "[]")
    except (AdvsearchError, ValueError):
        return {}
    facts: dict[str, dict[str, None]] = {}
    for sitting in noted if isinstance(noted, list) else []:
        for name, text in sitting.items() if isinstance(sitting, Mapping) else ():
            facts.setdefault(str(name), {})[str(text)] = None
    return {name: ", then ".join(texts) for name, texts in facts.items()}
