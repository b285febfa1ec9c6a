"""What the set-up installs, and the list of what the wheel was built with."""

import json
import re
from pathlib import Path

import sbom


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
