"""A suite for machines: JUnit XML, SARIF 2.1.0 and Markdown."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote
from xml.etree import ElementTree

from advsearch import __version__
from advsearch.questions.test.answer import FAILED, HELD, UNDECIDED, ClaimAnswer, SuiteResult
from advsearch.questions.test.words import TABLE_HEADS, facts, suite_text, table_rows

SARIF_SCHEMA = "https://docs.oasis-open.org/sarif/sarif/v2.1.0/errata01/os/schemas/sarif-schema-2.1.0.json"

MEANINGS = {
    "right": "The model is right in at least a share of the pictures that some controls span.",
    "not_broken": "No search finds a configuration within a budget that the model gets wrong.",
    "no_worse": "The model is right at most so many points less often than another one, on the same pictures.",
    "counterexample": "The model is right on the answer of an earlier search.",
}
"""What a claim of each kind says; the rules of SARIF."""


def junit(result: SuiteResult) -> str:
    """Return JUnit XML: a test case for each claim. What failed is a failure, what is undecided an error, and what is
    so as expected is skipped."""
    cases = result.claims
    bad = [one for one in cases if not one.accepted]
    counts = {
        "tests": len(cases),
        "failures": sum(one.answer == FAILED for one in bad),
        "errors": sum(one.answer == UNDECIDED for one in bad),
        "skipped": sum(one.accepted and one.answer != HELD for one in cases),
    }
    given = {name: str(count) for name, count in counts.items()}
    time = f"{result.seconds['total']:.3f}"
    root = ElementTree.Element("testsuites", {"name": "advsearch", **given, "time": time})
    suite = ElementTree.SubElement(root, "testsuite", {"name": _xml(result.title), **given, "time": time})
    properties = ElementTree.SubElement(suite, "properties")
    for name, value in {**facts(result), "run": result.run or ""}.items():
        ElementTree.SubElement(properties, "property", {"name": name, "value": _xml(value)})
    for one in cases:
        case = ElementTree.SubElement(
            suite,
            "testcase",
            {"name": one.name, "classname": _xml(f"{result.title}.{one.kind}"), "time": f"{one.seconds:.3f}"},
        )
        if one.answer != HELD:
            tag = "skipped" if one.accepted else "failure" if one.answer == FAILED else "error"
            said = ElementTree.SubElement(case, tag, {"message": _xml(f"{one.answer}: {one.reason}")})
            if tag != "skipped":
                said.set("type", one.answer)
            said.text = _xml("\n".join(filter(None, [one.statement, _picture(result, one), one.repeat])))
        else:
            ElementTree.SubElement(case, "system-out").text = _xml(f"{one.statement}\n{one.reason}")
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def sarif(result: SuiteResult) -> str:
    """Return SARIF 2.1.0: a rule for each kind of claim, and a result for each claim that is not held, at the suite's
    file. What is so as expected is `unchanged`, all else `new`."""
    kinds = list(dict.fromkeys(one.kind for one in result.claims))
    rules = [
        {"id": kind, "shortDescription": {"text": MEANINGS[kind]}, "defaultConfiguration": {"level": "error"}}
        for kind in kinds
    ]
    lines = Path(result.suite).read_text("utf-8").splitlines() if Path(result.suite).is_file() else []
    results = [
        {
            "ruleId": one.kind,
            "ruleIndex": kinds.index(one.kind),
            "level": "error" if one.answer == FAILED else "warning",
            "message": {"text": f"{one.name}: {one.answer}: {one.reason}. Claimed: {one.statement}."},
            "locations": [
                {
                    "physicalLocation": {
                        "artifactLocation": {"uri": quote(result.suite)},
                        "region": {"startLine": _line_of(one.name, lines)},
                    }
                }
            ],
            "partialFingerprints": {"claim/v1": one.name},
            "baselineState": "unchanged" if one.accepted else "new",
            "properties": {name: value for name, value in _properties(result, one).items() if value},
        }
        for one in result.claims
        if one.answer != HELD
    ]
    driver = {"name": "advsearch", "version": __version__, "rules": rules}
    invocation = {"executionSuccessful": not result.goes_on, "commandLine": result.command_line}
    run = {"tool": {"driver": driver}, "invocations": [invocation], "results": results}
    return json.dumps({"$schema": SARIF_SCHEMA, "version": "2.1.0", "runs": [run]}, indent=2, ensure_ascii=False) + "\n"


def markdown(result: SuiteResult) -> str:
    """Return a heading, a table of the claims, and how to repeat what is not held."""
    lines = [f"### {_plain(result.title)}", "", _plain(suite_text(result)), ""]
    lines += [_line(TABLE_HEADS), _line(["---"] * len(TABLE_HEADS)), *map(_line, table_rows(result))]
    lines += ["", ", ".join(f"{name} {_plain(value)}" for name, value in facts(result).items())]
    again = [one.repeat for one in result.claims if one.answer != HELD and one.repeat]
    lines += ["", "```sh", *again, "```"] if again else []
    return "\n".join(lines) + "\n"


def _properties(result: SuiteResult, one: ClaimAnswer) -> dict[str, object]:
    return {"picture": _picture(result, one), "repeat": one.repeat, "pictures": one.pictures}


def _picture(result: SuiteResult, one: ClaimAnswer) -> str:
    return f"{result.run}/{one.picture}" if one.picture else ""


def _xml(text: str) -> str:
    """What XML can hold of a text."""
    return re.sub(r"[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", text)


def _line_of(name: str, lines: Sequence[str]) -> int:
    """The line of a suite's file, from 1, in which a claim begins; the first for what stands elsewhere."""
    begins = re.compile(rf"\s+{re.escape(name)}\s*:")
    return next((number for number, line in enumerate(lines, start=1) if begins.match(line)), 1)


def _plain(text: str) -> str:
    """A text in which Markdown has nothing to read."""
    return re.sub(r"([\\`*_{}\[\]<>#|])", r"\\\1", " ".join(text.split()))


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(one if one == "---" else _plain(one) for one in cells) + " |"
