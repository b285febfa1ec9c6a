"""What the set-up installs, and the list of what the wheel was built with."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path

import sbom

from conftest import ROOT

TRIED = """
source tools/setup.sh python3 "$1/venv"
as_root() { "$@"; }
may_install() { command -v apt-get >/dev/null; }
ensure_llvm
"""


def ensured(tmp_path: Path, **environment: str) -> tuple[subprocess.CompletedProcess[str], str]:
    """What the set-up says where there is no libLLVM, and what it asked of a stand-in for apt-get, which brings one."""
    (tmp_path / "venv" / "bin").mkdir(parents=True)
    asked, there = tmp_path / "asked", tmp_path / "there"
    for path, text in (
        (tmp_path / "venv" / "bin" / "python", f"[ -e {there} ] && echo 19.1"),
        (tmp_path / "apt-get", f'echo "$@" >> {asked}; touch {there}'),
    ):
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)
    environ = {key: value for key, value in os.environ.items() if not key.startswith(("DRJIT_", "ADVSEARCH_NO"))}
    environ |= {"PATH": f"{tmp_path}:{os.environ['PATH']}", **environment}
    words = ["bash", "-c", TRIED, "bash", str(tmp_path)]
    done = subprocess.run(words, cwd=ROOT, env=environ, capture_output=True, text=True, check=False)
    return done, asked.read_text() if asked.exists() else ""


def test_a_system_package_is_told_before_it_is_installed(tmp_path: Path) -> None:
    done, asked = ensured(tmp_path)
    assert done.returncode == 0 and asked == "install -y -q --no-install-recommends libllvm19\n"
    assert "installs a system package as root: apt-get install -y -q --no-install-recommends libllvm19" in done.stdout


def test_the_list_of_packages_is_cyclonedx_and_has_every_line_of_the_lock(tmp_path: Path) -> None:
    path = sbom.main(tmp_path / "dist")
    found = json.loads(path.read_text())
    assert (found["bomFormat"], found["specVersion"], found["version"]) == ("CycloneDX", "1.6", 1)
    assert re.fullmatch(r"urn:uuid:[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}", found["serialNumber"])
    components = [found["metadata"]["component"], *found["components"]]
    for one in components:
        assert one["type"] in ("application", "library") and one["name"] and one["version"]
        assert re.fullmatch(r"pkg:pypi/[a-z0-9.-]+@[^@/]+", one["purl"]) and one["bom-ref"] == one["purl"]
    assert len({one["bom-ref"] for one in components}) == len(components)
    lines = [line.partition(";")[0].strip() for line in sbom.CONSTRAINTS.read_text().splitlines() if line[0] != "#"]
    assert [f"{one['name']}=={one['version']}" for one in found["components"]] == lines
    scopes = {one["name"]: one["scope"] for one in found["components"]}
    assert scopes["mitsuba"] == scopes["torch"] == "required" and scopes["pytest"] == "optional"
    assert any("python_version" in one["properties"][0]["value"] for one in components if "properties" in one)
    assert sbom.main(tmp_path / "again").read_text() == path.read_text()
