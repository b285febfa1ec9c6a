"""Registries: our own entries, those of installed packages, and a package made from the pages that say how."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from advsearch import registry
from advsearch.catalog import BuiltIn
from advsearch.errors import InputError
from advsearch.registry import Registry

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"


class Point:
    """An entry point."""

    def __init__(self, name: str, entry: Any) -> None:
        self.name, self.value, self._entry = name, f"other:{name}", entry

    def load(self) -> Any:
        if isinstance(self._entry, Exception):
            raise self._entry
        return self._entry


def with_points(monkeypatch: pytest.MonkeyPatch, *points: Point) -> Registry[int]:
    monkeypatch.setattr(registry, "entry_points", lambda group: points if group == "advsearch.numbers" else ())
    own: dict[str, int | BuiltIn] = {"one": 1, "mod": BuiltIn("number", "mod", "sys:maxsize", "the largest index")}
    return Registry("advsearch.numbers", own, "a number", lambda name, entry: isinstance(entry, int))


def test_own_entries_come_first_and_win_and_those_of_the_catalog_are_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = with_points(monkeypatch, Point("one", 100), Point("two", 2))
    assert list(numbers) == ["one", "mod", "two"] and len(numbers) == 3
    assert (numbers["one"], numbers["mod"], numbers["two"]) == (1, sys.maxsize, 2)
    assert "three" not in numbers
    assert numbers.get_help("mod") == "The largest index."


@pytest.mark.parametrize(
    ("entry", "complaint"),
    [
        ("two", "expected a number"), (ImportError("no module x"), r"cannot be imported \(no module x\)"),
        (RuntimeError("too old"), r"cannot be imported \(too old\)"),
    ],
)  # fmt: skip
def test_an_entry_that_does_not_fit_is_named_with_its_package(
    monkeypatch: pytest.MonkeyPatch, entry: Any, complaint: str
) -> None:
    numbers = with_points(monkeypatch, Point("two", entry), Point("three", 3))
    with pytest.raises(InputError, match=rf"entry point two = other:two of group advsearch\.numbers: {complaint}"):
        numbers["two"]
    assert list(numbers) == ["one", "mod", "two", "three"] and numbers["three"] == 3  # it disturbs no other
    assert [*numbers.list_usable()] == ["one", "mod", "three"]
    assert numbers.get_help("two").endswith("repair or uninstall the package that declares it.")


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text("utf-8"), re.S)


def made_from_the_pages(folder: Path) -> Path:
    """Write the package that docs/extending.md describes."""
    page = (DOCS / "extending.md").read_text("utf-8")
    (folder / "my_package").mkdir(parents=True)
    (folder / "setup.cfg").write_text(blocks("extending.md", "ini")[0])
    (folder / "pyproject.toml").write_text(
        '[build-system]\nrequires = ["setuptools"]\nbuild-backend = "setuptools.build_meta"\n'
    )
    names = re.findall(r"^`my_package/(\w+)\.py`", page, re.M)
    sources = dict(zip(names, blocks("extending.md", "python"), strict=True))
    sources |= {"fade": blocks("controls/writing.md", "python")[0], "__init__": ""}
    for name, source in sources.items():
        (folder / "my_package" / f"{name}.py").write_text(source)
    return folder


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which that package is installed."""
    folder = tmp_path_factory.mktemp("outside")
    package, target = made_from_the_pages(folder / "package"), folder / "installed"
    pip = [sys.executable, "-m", "pip", "install", "-qq", "--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run([*pip, "--disable-pip-version-check", "--target", str(target), str(package)], check=True)
    return target


def advsearch(installed: Path, *commands: list[str]) -> list[Any]:
    """Carry commands out, one after the other in one process beside the installed package; return their answers."""
    code = "import json, sys\nfrom advsearch.cli.main import main\nsys.exit(max(map(main, json.loads(sys.argv[1]))))"
    words = json.dumps([[*command, "--json"] for command in commands])
    outside = {**os.environ, "PYTHONPATH": str(installed)}
    done = subprocess.run([sys.executable, "-c", code, words], stdout=subprocess.PIPE, env=outside, text=True)
    assert done.returncode == 0
    answers, decoder, text = list[Any](), json.JSONDecoder(), done.stdout.lstrip()
    while text:
        answer, end = decoder.raw_decode(text)
        answers.append(answer)
        text = text[end:].lstrip()
    return answers


def examples() -> list[list[str]]:
    """The words of the page's commands, each behind `advsearch`."""
    lines = blocks("extending.md", "text")[0].splitlines()
    return [line.split()[1:] for line in lines if line.startswith("advsearch")]


@pytest.mark.medium
@pytest.mark.docs
def test_its_names_are_listed_and_its_parts_work_together(installed: Path, tmp_path: Path) -> None:
    """Its task, too, is searched, swept and rendered; all in one process."""
    small = ["--run", str(tmp_path / "own"), "--no-baseline", "--steps", "4", "--spp", "1", "--verify-spp", "1"]
    words = [*examples()[0], *small, "--denoise", "none", "--label", "bowl", "--quiet"]
    small, run = ["--denoise", "none", "--spp", "16", "--quiet"], tmp_path / "run"
    attack = [*examples()[1], "--run", str(run), "--no-baseline", "--steps", "12", "--verify-spp", "16", *small]
    given = ["--object", "mug", "--task", "fading", "--model", "zoo:gauge", *small]
    sweep = ["sweep", *given, "--grid", "fade.amount=0,0.4,1", "--trials", "0", "--run", str(tmp_path / "sweep")]
    wide = [*(word.replace("fading", "fading={tolerance: 2}") for word in sweep), "--overwrite"]
    picture = ["render", *given, "--control", "fade={amount: 0.4}", "--out", str(tmp_path / "mug.png")]
    exposed = ["attack", "--object", "mug", "--model", "zoo:tiny", "--label", "bowl", "--run", str(tmp_path / "lit")]
    exposed += ["--control", "camera={azimuth: 40, elevation: 25, roll: 0, sizes: 2.4, exposure: [-2, 2]}"]
    exposed += ["--steps", "6", "--trials", "6", "--resolution", "32", "--no-baseline", "--verify-spp", "16", *small]
    listed, summary, found, swept, widely, rendered, lit = advsearch(
        installed, ["list"], words, attack, sweep, wide, picture, exposed
    )

    names = {"controls": "fade", "policies": "shrinking", "objectives": "brightness", "tasks": "fading"}
    assert {kind: listed[kind][-1] for kind in names} == names
    assert (summary["controls"], summary["policy"], summary["objective"]) == (["fade"], "shrinking", "brightness")
    assert summary["model"] == "tiny" and summary["steps"] == 4

    assert (found["task"], found["objective"], found["model"]) == ("fading", "score", "gauge")
    assert found["label_set"] == ["0.0"] and found["clean"]["correct"] and found["clean"]["index"] is None
    assert found["ending"] == "found" and found["configuration"]["fade.amount"]["value"] > 0.7
    assert found["adversarial"]["label"].endswith(" faded") and found["verified"]["margin"] < 0.0
    assert "task: fading" in (run / "run.yaml").read_text("utf-8")

    assert (swept["task"], swept["correct"], swept["configurations"]) == ("fading", 2, 3)
    assert swept["worst"]["values"]["fade.amount"]["value"] == 1.0 and swept["worst"]["label_set"] == ["1.0"]
    assert (widely["task"], widely["correct"]) == ("fading", 3)
    assert "name: fading\n  tolerance: 2\n" in (tmp_path / "sweep" / "run.yaml").read_text("utf-8")

    assert lit["transport"]["method"] == "still" and lit["renders"]["products"] == lit["steps"] == 6
    (view,) = rendered["views"]
    assert view["answers"][0]["probability"] is None and 0.3 < float(view["answers"][0]["label"].split()[0]) < 0.5


@pytest.mark.medium
@pytest.mark.docs
def test_its_cluster_does_the_work_of_a_sweep(installed: Path, tmp_path: Path) -> None:
    small = ["--model", "zoo:tiny", "--resolution", "32", "--spp", "1", "--denoise", "none", "--batch", "4", "--quiet"]
    command, trials = examples()[2], ["--trials", "0"]
    assert command[-4:] == ["--cluster", "pool", "--workers", "2"]
    shared, single = advsearch(
        installed,
        [*command, *small, *trials, "--run", str(tmp_path / "pool")],
        [*command[:-4], *small, *trials, "--run", str(tmp_path / "here")],
    )
    assert shared["shared"]["batches"] == 6 and "shared" not in single
    assert (shared["correct"], shared["worst"]) == (single["correct"], single["worst"])


USE_PARTS = """
import json, sys
from pathlib import Path
from advsearch.controls import make_control
from advsearch.progress import NullProgress
from advsearch.runs.exporters import EXPORTERS
from advsearch.runs.store import Row, Store
from advsearch.scene.importing.objects import import_object

run = Path("run")
run.mkdir()
(run / "run.yaml").write_text("command: sweep\\n")
with Store(run / Store.FILE) as store:
    store.append([Row("sweep", step, margin=margin) for step, margin in enumerate((0.5, -1.5))])
exported = EXPORTERS["margins"]().write("run", Path("margins.txt"), {}, NullProgress())
mesh = import_object("cube.off").mesh
print(json.dumps([make_control("fade", {"amount": [0, 1]}).kind, exported.facts, exported.text, len(mesh.faces)]))
try:
    import_object("broken.off")
except Exception as error:
    print(error)
"""

CUBE = """OFF
8 12 0
0 0 0  1 0 0  1 1 0  0 1 0  0 0 1  1 0 1  1 1 1  0 1 1
3 0 2 1  3 0 3 2  3 4 5 6  3 4 6 7  3 0 1 5  3 0 5 4
3 1 2 6  3 1 6 5  3 2 3 7  3 2 7 6  3 3 0 4  3 3 4 7
"""


def test_its_control_exporter_and_reader_work(installed: Path, tmp_path: Path) -> None:
    (tmp_path / "cube.off").write_text(CUBE)
    (tmp_path / "broken.off").write_text(CUBE.replace("3 0 2 1", "3 0 9 1"))
    outside = {**os.environ, "PYTHONPATH": os.pathsep.join([str(installed), str(ROOT)])}
    done = subprocess.run(
        [sys.executable, "-c", USE_PARTS], cwd=tmp_path, env=outside, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    answer, refusal = done.stdout.splitlines()
    assert json.loads(answer) == ["fade", {"rows": 2}, "2 margins in margins.txt.", 12]
    assert (tmp_path / "margins.txt").read_text() == "0.5\n-1.5\n"
    assert "broken.off: expected faces with points that are there" in refusal
