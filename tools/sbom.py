"""Writes the software bill of materials of the wheel: every package of constraints.txt,
as CycloneDX 1.6 in JSON.

    python tools/sbom.py dist   # dist/advsearch-VERSION.cdx.json

What advsearch itself needs is "required", what only its extras and its development need
"optional". A package that only some versions of Python need has the condition as a
property. The same lock gives the same file.
"""

from __future__ import annotations

import json
import sys
import uuid
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
CONSTRAINTS = ROOT / "constraints.txt"
NAME = "advsearch"


def main(folder: Path) -> Path:
    """Write the file into a folder and return its path."""
    found = bill(CONSTRAINTS.read_text(encoding="utf-8"), metadata.version(NAME))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{NAME}-{found['metadata']['component']['version']}.cdx.json"
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return path


def bill(constraints: str, version: str) -> dict[str, Any]:
    """Return the document (https://cyclonedx.org/docs/1.6/json) of a lock in the form
    of pip's constraints.
    """
    components = list(locked(constraints))
    needed = set(needs(NAME))
    for one in components:
        one["scope"] = (
            "required" if canonicalize_name(one["name"]) in needed else "optional"
        )
    content = json.dumps([version, components], sort_keys=True)
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": uuid.uuid5(uuid.NAMESPACE_URL, content).urn,
        "version": 1,
        "metadata": {"component": {"type": "application", **_named(NAME, version)}},
        "components": components,
    }


def locked(constraints: str) -> Iterator[dict[str, Any]]:
    """Yield a component for each line ``NAME==VERSION ; CONDITION``. Raises ValueError
    where a line pins no version.
    """
    for line in constraints.splitlines():
        text = line.partition("#")[0].strip()
        if not text:
            continue
        pinned = Requirement(text)
        (only,) = pinned.specifier
        if only.operator != "==":
            raise ValueError(f"{text}: expected one exact version")
        more: Mapping[str, Any] = {}
        if pinned.marker is not None:
            more = {
                "properties": [
                    {"name": f"{NAME}:condition", "value": str(pinned.marker)}
                ]
            }
        yield {"type": "library", **_named(pinned.name, only.version), **more}


def needs(package: str) -> Iterator[str]:
    """Yield the names of all packages that an installed one needs here, without extras;
    those of others included.
    """
    left = [(package, "")]
    seen = {(package, "")}
    while left:
        name, extra = left.pop()
        try:
            texts = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue
        for one in map(Requirement, texts):
            if one.marker is None or one.marker.evaluate({"extra": extra}):
                inner = canonicalize_name(one.name)
                yield inner
                new = {(inner, ""), *((inner, other) for other in one.extras)} - seen
                seen |= new
                left += new


def _named(name: str, version: str) -> dict[str, str]:
    purl = f"pkg:pypi/{canonicalize_name(name)}@{version}"
    return {"name": name, "version": version, "purl": purl, "bom-ref": purl}


if __name__ == "__main__":
    print(main(Path(sys.argv[1] if len(sys.argv) > 1 else "dist")))
