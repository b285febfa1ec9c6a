"""The ways to get and run advsearch beside `make`: the action for GitHub, the container and the list for programs."""

import os
import re
import subprocess
import sys
from configparser import ConfigParser
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
ACTION = yaml.safe_load((ROOT / "action.yml").read_text())
DOCKERFILE = (ROOT / "Dockerfile").read_text()


def steps() -> dict[str, dict[str, object]]:
    return {step["name"]: step for step in ACTION["runs"]["steps"] if "run" in step}


def test_values_reach_the_scripts_of_the_action_as_variables_alone() -> None:
    scripts = [str(step["run"]) for step in steps().values()]
    assert len(scripts) == 3 and not any("${{" in script for script in scripts), "an input could be a command"
    given = re.findall(r"inputs\.([a-z-]+)", str(ACTION["runs"]))
    assert set(given) == set(ACTION["inputs"])


@pytest.mark.island("advsearch.questions.test")
@pytest.mark.parametrize(("pitch", "status"), [("0, 1", 0), ("80, 90", 1)])
def test_the_step_of_the_action_that_tests(tmp_path: Path, pitch: str, status: int) -> None:
    (tmp_path / "suite.yaml").write_text(
        "settings: {object: mug, model: reference, resolution: 64}\n"
        f"claims: {{lying: {{claim: right, at_least: 0.5, pictures: 60, settings: "
        f"{{controls: {{pose: {{pitch: [{pitch}]}}}}}}}}}}\n"
    )
    inputs = {"SUITE": "suite.yaml", "MODEL": "reference", "CODE": "", "ARGUMENTS": "--seed 3 --all"}
    files = {"GITHUB_OUTPUT": str(tmp_path / "output"), "GITHUB_STEP_SUMMARY": str(tmp_path / "page")}
    assert inputs.keys() == steps()["Test"]["env"].keys()  # type: ignore[attr-defined]
    env = {**os.environ, **inputs, **files, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-eo", "pipefail", "-c", str(steps()["Test"]["run"])],
        cwd=tmp_path, env=env, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == status, done.stderr
    assert "lying" in Path(files["GITHUB_STEP_SUMMARY"]).read_text()
    kept = dict(line.split("=") for line in Path(files["GITHUB_OUTPUT"]).read_text().split())
    assert sorted(kept) == sorted(ACTION["outputs"])
    assert all((tmp_path / file).stat().st_size > 0 for file in kept.values())


def test_container_and_action_install_what_the_set_up_does() -> None:
    package = re.search(r"install_command=\(.* (\S+)\)", (ROOT / "tools/setup.sh").read_text())
    assert package and f" {package[1]} " in f"{DOCKERFILE} " and package[1] in str(steps()["Install libLLVM"]["run"])
    config = ConfigParser()
    config.read(ROOT / "setup.cfg")
    extras = re.search(r"'/advsearch\[(.*)\]'", DOCKERFILE)
    assert extras and set(extras[1].split(",")) <= set(config["options.extras_require"])
