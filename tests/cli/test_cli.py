"""The command line: what it prints where, its exit statuses, and that it answers at once."""

from __future__ import annotations

import ctypes
import io
import json
import os
import re
import resource
import subprocess
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import advsearch
import samples
from advsearch import __version__
from advsearch.cli import doctor
from advsearch.cli import show as names
from advsearch.cli.flags import format_as_flags
from advsearch.cli.main import get_command_help, list_commands, main
from advsearch.cli.output import align_columns, print_result
from advsearch.cli.output import format_result as text_of
from advsearch.controls.base import Choice
from advsearch.errors import InputError, StorageError
from advsearch.options import Value
from advsearch.progress import BarProgress, LineProgress, NullProgress, Progress, open_progress
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.region.result import RegionConfig
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row
from advsearch.scene.settings import Parameter
from advsearch.settings import Config, settings
from conftest import ROOT
from samples import ATTACK, AVERAGE, BRACKET, EASIER, SUMMARY, TARGET, make_run, rated

HEAVY = ("torch", "mitsuba", "drjit", "numpy", "scipy", "pydantic", "rich", "yaml", "PIL")

Api = Callable[..., Any]


def noting(given: list[Any], answer: Any) -> Api:
    """Return a function that keeps what it is called with first, goes on with no run, and answers that."""

    def called(first: Any, *more: Any, resumed: Path | None = None, **named: Any) -> Any:
        assert resumed is None
        given.append(first)
        return answer

    return called


@pytest.fixture
def api(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Put a stand-in in the place of `advsearch.experiment.run_experiment`."""

    def not_wanted(config: Config, **named: Any) -> Any:
        raise AssertionError(f"the command line asked for {config.command}")

    return lambda answering=not_wanted: monkeypatch.setattr("advsearch.experiment.run_experiment", answering)


@pytest.fixture
def asked(api: Callable[..., None]) -> list[AttackConfig]:
    """The configurations that a successful stand-in was given."""
    given: list[AttackConfig] = []

    def attack(config: AttackConfig, *, progress: Progress, resumed: Path | None = None) -> Any:
        given.append(config)
        return SUMMARY

    api(attack)
    return given


def python(code: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a piece of Python in a process of its own."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, **options)


# ---- the program ----


def test_help_is_quick_and_imports_nothing_heavy() -> None:
    code = (
        "import sys; from advsearch.cli.main import main; status = main(['--help']);"
        f"print(sorted(set({HEAVY}) & set(sys.modules)), file=sys.stderr); sys.exit(status)"
    )
    seconds = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = python(code)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)  # CPU seconds: what others do on the machine takes none
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert (done.returncode, done.stderr) == (0, "[]\n")
    assert all(name in done.stdout for name in list_commands())
    assert min(seconds) < 0.5


def test_help_has_four_groups_and_each_command_once_with_its_whole_help(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    assert main(["--help"]) == 0
    listing = capsys.readouterr().out.partition("\nask: ")[2].partition("\n\nexamples:")[0]
    assert max(map(len, listing.splitlines())) <= 60
    groups = listing.split("\n\n")
    assert [group.partition(": ")[0] for group in groups[1:]] == ["look", "trust", "files and runs"]
    shown = re.findall(r"^  ([a-z0-9-]+) +(.+(?:\n {4,}.*)*)", listing, re.M)
    assert [name for name, _ in shown] == list_commands()
    for name, text in shown:
        assert " ".join(text.split()) == get_command_help(name)


@pytest.mark.parametrize("command", list_commands())
def test_every_command_has_help_and_json(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    out, err = capsys.readouterr()
    assert out.startswith("usage: advsearch " + command) and "--json" in out and err == ""


def test_help_of_attack_shows_every_setting_with_range_and_default(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["attack", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for setting in settings(AttackConfig):
        assert f"{setting.flag} " in text
        if not setting.is_switch:
            assert setting.expects in text and setting.unit in text
    assert "a whole number from 1 to 1000000 (default: 40; for textures and the like with --over " in text
    assert "in texels (default: chosen from the object's own)" in text


def test_no_command_prints_help_and_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert "commands:" in capsys.readouterr().out
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"advsearch {__version__}\n"


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["atack"], "unknown command 'atack'. Did you mean 'attack'? Known: attack, check, "),
        (["--jsn"], "unknown flag '--jsn'."),
        (["attack", "--epsilom", "1"], "unknown flag '--epsilom'. Did you mean '--epsilon'"),
        (["attack", "--eps", "1"], "unknown flag '--eps'. Did you mean '--epsilon'?"),
        (["region", "--workers", "2"], "advsearch region has no --workers, a flag of advsearch attack, sweep"),
        (["attack", "mug"], "expected flags, got 'mug'; for the object write --object mug; see advsearch attack -"),
        (["attack", "--steps"], "argument --steps: expected one argument; see advsearch attack --help"),
        (["attack"], "--object: expected the name of an object or a .obj, .ply, .stl, "),
        (["attack", "--object", "mug", "--epsilon", "nan"], "--epsilon: expected a number greater than 0 and at"),
        (["attack", "--object", "mug", "--epsilon", "-0.1"], "--epsilon: expected a number greater than 0 and at"),
        (["attack", "--object", "mug", "--control", ","], "--control: expected names of controls, or NAME="),
        (["attack", "--object", "mug", "--set", "a"], "--set: expected PARAMETER=VALUE with a finite number"),
        (["attack", "--object", "mug", "--set", "a=nan"], "--set: expected PARAMETER=VALUE with a finite number"),
        (["run"], "the following arguments are required: FILE"),
        (["run", "no.yaml"], "no.yaml: expected a YAML file, got No such file or directory; check the path"),
        (["show", "no-run"], "unknown run 'no-run'."),
        (["show", "control", "a", "b"], "expected the name of a run, or one of control NAME, policy NAME, "),
        (["list", "cups"], "argument kind: invalid choice: 'cups'"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_status_2(
    argv: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(argv) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(f"advsearch: error: {message}") and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("epsilon: expected a number; steps: expected more", "--epsilon: expected a number; --steps: expected more"),
        ("x.yaml: epsilon: expected a number", "x.yaml: epsilon: expected a number"),
        ("lower `verify_spp` or use `denoise=none`", "lower --verify-spp or use --denoise none"),
        ("add `overwrite=True` or leave `baseline=False` out", "add --overwrite or leave --no-baseline out"),
        ("`controls` key: taken; leave `set` out", "--control key: taken; leave --set out"),
        ("`grid` pose.yaw: several", "--grid pose.yaw: several"),
        ("model x.pt2: `layout` is for the network", "model x.pt2: `layout` is for the network"),
        ("outputs hardly move; give `value_range=0,255`", "outputs hardly move; give --value-range 0,255"),
    ],
)
def test_settings_in_messages_become_flags(message: str, shown: str) -> None:
    assert format_as_flags(message) == shown


def test_a_message_names_the_argument_in_python_and_the_flag_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"^up: bundled objects stand upright already; leave `up` out"):
        advsearch.attack("mug", up="z")
    assert main(["attack", "--object", "mug", "--up", "z"]) == 2
    assert "error: --up: bundled objects stand upright already; leave --up out" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"^smallest: finds one epsilon by itself; give one `epsilon` as the largest"):
        advsearch.attack("mug", smallest=True, epsilon=(0.1, 0.2))
    assert main(["attack", "--object", "mug", "--smallest", "--epsilon", "0.1,0.2"]) == 2
    assert "error: --smallest: finds one epsilon by itself; give one --epsilon as" in capsys.readouterr().err


@pytest.mark.medium
def test_a_bug_keeps_its_traceback_and_ends_with_1() -> None:
    code = (
        "import sys, advsearch.experiment\n"
        "def carry_out(config, *, progress, resumed): raise ValueError('a bug')\n"
        "advsearch.experiment.run_experiment = carry_out\n"
        "from advsearch.cli.main import main; sys.exit(main(['attack', '--object', 'mug', '--json']))"
    )
    path = os.pathsep.join(map(str, (ROOT, ROOT / "tests")))
    done = python(code, cwd=Path(__file__).parent, env={**os.environ, "PYTHONPATH": path})
    assert done.returncode == 1 and done.stdout == ""
    assert "Traceback" in done.stderr and done.stderr.endswith("ValueError: a bug\n")


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (InputError("--object: no such thing"), 2, "advsearch: error: --object: no such thing\n"),
        (StorageError("the disk is full"), 2, "advsearch: error: the disk is full\n"),
        (KeyboardInterrupt(), 130, "advsearch: interrupted\n"),
    ],
)
def test_what_the_api_raises_becomes_a_status(
    api: Callable[..., None], capsys: pytest.CaptureFixture[str], error: BaseException, status: int, message: str
) -> None:
    def attack(config: AttackConfig, *, progress: Progress, resumed: Path | None = None) -> Any:
        raise error

    api(attack)
    assert main(["attack", "--object", "mug", "--json"]) == status
    assert capsys.readouterr() == ("", message)


@pytest.mark.parametrize(("ending", "status"), [("interrupted", 130), ("found", 0), ("budget spent", 0)])
def test_a_result_of_a_run_that_was_stopped_has_the_status_of_an_interrupt(
    ending: str, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    result: Any = types.SimpleNamespace(ending=ending, run=None)
    monkeypatch.setattr("advsearch.cli.output.format_result", lambda result: "the result")
    assert print_result(result, as_json=False) == status


SWALLOWING = """
import importlib.abc, importlib.util, os, signal, sys

Done = {'ending': 'found'}

def interrupted():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        while True:
            pass
    except KeyboardInterrupt:
        print("swallowed", flush=True)

def carry_out(config, *, progress, resumed):
    import heavy
    {loading}
    print("searched", flush=True)
    sys.exit("expected nothing to be searched")

class Swallows(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def find_spec(self, name, path, target=None):
        return importlib.util.spec_from_loader(name, self) if name == "heavy" else None

    def exec_module(self, module):
        {importing}

sys.meta_path.insert(0, Swallows())
sys.argv[1:] = ["attack", "--object", "mug", "--json", *sys.argv[1:]]
import advsearch.experiment
from advsearch.cli.main import main
advsearch.experiment.run_experiment = carry_out
sys.exit(main())
"""


@pytest.mark.medium
@pytest.mark.parametrize("quiet", [[], ["--quiet"]])
@pytest.mark.parametrize(
    "where",
    [
        {"importing": "interrupted()", "loading": "progress.stage('loading')"},
        {"importing": "pass", "loading": "progress.stage('loading'); interrupted(); progress.stage('searching', 9)"},
        {"importing": "pass", "loading": "interrupted(); return Done"},
    ],
    ids=["importing", "loading", "without a stage"],
)
def test_an_interrupt_that_an_import_swallows_is_not_lost(where: dict[str, str], quiet: list[str]) -> None:
    """Imports of others catch everything, so that what came meanwhile is raised when the stage ends."""
    code = SWALLOWING.replace("{importing}", where["importing"]).replace("{loading}", where["loading"])
    done = subprocess.run([sys.executable, "-c", code, *quiet], capture_output=True, text=True, timeout=600)
    assert done.returncode == 130 and "searched" not in done.stdout + done.stderr
    assert "swallowed" in done.stdout + done.stderr and done.stderr.endswith("advsearch: interrupted\n")


def test_an_interrupted_process_ends_without_the_interpreters_own_end() -> None:
    """What an interrupt inside native code leaves behind aborts there: status 134 and a dump of threads."""
    code = "import atexit, os; from advsearch.cli import main; main._status = lambda given: print('answer') or 130; "
    code += "atexit.register(os.abort); from advsearch.__main__ import start; start()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert (done.returncode, done.stdout, done.stderr) == (130, "answer\n", "")


def test_a_reader_that_goes_away_is_no_error() -> None:
    code = "import sys; from advsearch.cli.main import main; sys.stdin.read(); sys.exit(main(['--help']))"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdin and process.stdout and process.stderr
        process.stdout.close()
        process.stdin.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0


# ---- attack and run ----


def test_attack_builds_its_configuration_from_flags(asked: list[AttackConfig]) -> None:
    argv = (
        "attack --object mug.obj --up y --environment room.hdr --model net.pt2 --labels l.json --label cup --norm l2"
        " --control texture,pose --control light --set camera.azimuth=130 --set a.b=[0,1] --epsilon 0.1 --exposure -1"
        " --texture-resolution 64 --policy random --steps 3 --objective margin --spp 4 --verify-spp 32"
        " --trials 7 --denoise none --resolution 64x96 --no-baseline --seed 9 --threads 1 --run x --overwrite"
        " --deterministic --quiet"
    )
    assert main([*argv.split(), "--control", "patch={size: 0.3}"]) == 0
    assert asked == [
        AttackConfig(
            object="mug.obj", up="y", environment="room.hdr", model="net.pt2", labels="l.json", label="cup",
            controls={"texture": {}, "pose": {}, "light": {}, "patch": {"size": 0.3}},
            set_={"camera.azimuth": 130, "a.b": [0, 1]}, epsilon=0.1, norm="l2", texture_resolution=64, policy="random",
            steps=3, objective="margin", spp=4, verify_spp=32, trials=7, denoise="none",
            resolution=(64, 96), exposure=-1, baseline=False, seed=9, threads=1, run="x", overwrite=True,
            deterministic=True,
        )
    ]  # fmt: skip


def test_attack_needs_only_an_object(asked: list[AttackConfig]) -> None:
    assert main(["attack", "--object", "mug"]) == 0
    assert asked == [AttackConfig(object="mug")]
    assert list(asked[0].controls) == ["texture"]


def test_attack_prints_the_table(asked: list[AttackConfig], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["attack", "--object", "mug"]) == 0
    out, err = capsys.readouterr()
    assert out == text_of(SUMMARY) + "\n" and err == ""


def test_json_is_all_that_stands_on_standard_output(
    api: Callable[..., None], capfd: pytest.CaptureFixture[str]
) -> None:
    def attack(config: AttackConfig, *, progress: Progress, resumed: Path | None = None) -> Any:
        print("an objective of the user prints")
        os.write(1, b"so does a native library\n")
        ctypes.CDLL(None).puts(b"and one that buffers")
        progress.message("a warning")
        return samples.attack(seconds={"total": float("nan")})

    api(attack)
    assert main(["attack", "--object", "mug", "--json"]) == 0
    out, err = capfd.readouterr()
    found = json.loads(out, parse_constant=lambda text: pytest.fail(f"{text} is not JSON"))
    assert found == samples.attack(seconds={"total": None}).to_dict()
    for text in ("an objective of the user prints", "so does a native library", "and one that buffers", "a warning"):
        assert text in err


@pytest.mark.parametrize(
    ("ending", "status"), [("found", 0), ("budget spent", 0), ("already wrong", 0), ("interrupted", 130)]
)
def test_the_status_of_an_attack(api: Callable[..., None], ending: str, status: int) -> None:
    api(lambda config, progress, resumed: samples.attack(ending=ending))
    assert main(["attack", "--object", "mug"]) == status
    assert main(["attack", "--object", "mug", "--json"]) == status


def test_run_reads_a_file_and_puts_changes_over_it(asked: list[AttackConfig], tmp_path: Path) -> None:
    path = tmp_path / "run.yaml"
    path.write_text(AttackConfig(object="mug", steps=10, seed=4).to_yaml())
    assert (
        main(["run", str(path), "steps=80", "set.camera.azimuth=130", "--run", "again", "--overwrite", "--quiet"]) == 0
    )
    assert asked == [
        AttackConfig(object="mug", steps=80, seed=4, set_={"camera.azimuth": 130}, run="again", overwrite=True)
    ]


@pytest.mark.parametrize(
    ("text", "change", "message"),
    [
        (
            "object: mug\ncommand: atack\n",
            [],
            "unknown command 'atack'. Did you mean 'attack'? Known: attack, check, compare, explain, harden, ",
        ),
        ("object: mug\n", ["steps"], "change 'steps': expected NAME=VALUE such as camera.azimuth=130, got 'steps'"),
        ("object: mug\n", ["step=3"], "unknown setting 'step'. Did you mean 'steps'"),
        ("object: mug\n", ["steps=0"], "run.yaml: steps: expected a whole number from 1 to 1000000, got 0"),
    ],
)
def test_a_bad_file_or_change_is_told(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    text: str,
    change: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run.yaml").write_text(text)
    assert main(["run", "run.yaml", *change]) == 2
    assert capsys.readouterr().err.startswith(f"advsearch: error: {message}")


# ---- studies, regions and sweeps ----


@pytest.mark.parametrize("line", ["--object mug,bowl", "--object mug --epsilon 0.01,0.1"])
def test_several_objects_or_epsilons_are_a_curve(
    api: Callable[..., None], capsys: pytest.CaptureFixture[str], line: str
) -> None:
    given: list[Any] = []
    api(noting(given, samples.curve()))
    assert main(["attack", *line.split(), "--quiet"]) == 0
    assert given[0].is_study
    assert capsys.readouterr().out == (
        "Still recognised: 3 of 4 at epsilon 0.01.\n\n"
        "Robust accuracy\n"
        "  epsilon   robust   accuracy   95 % interval   wrong already\n"
        "  0.01      3/4      75 %       35-97 %         1\n\n"
        "The objects, at the last epsilon tried\n"
        "  object   clean right   ending        epsilon   wrong   margin\n"
        "  mug      20/20         found         0.1       19/20   1.50\n"
        "  bowl                   not reached\n\n"
        "Margin: how far the right prediction leads the wrong one, in logits, in the trials of the worst case.\n\n"
        "  model         reference\n"
        "  policy        auto\n"
        "  environment   studio\n"
        "  time          9.0 s\n"
        "  seed          0\n"
        "  page          runs/mug-texture-001/report.html\n"
    )
    assert main(["attack", *line.split(), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == samples.curve().to_dict()


def test_an_interrupted_study_says_how_to_go_on(api: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    answer = samples.curve(ending="interrupted")
    api(lambda config, progress, resumed: answer)
    assert main(["attack", "--object", "mug,bowl"]) == 130
    assert capsys.readouterr().out.endswith(
        f"\n\nNote: Not finished: these are the results so far.\n\n"
        f"Go on with: advsearch resume {Path(str(answer.run)).name}\n"
    )


def test_region_builds_its_configuration_and_prints_the_box(
    api: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    given: list[Any] = []
    api(noting(given, samples.region()))
    argv = "region --object mug --control pose.yaw,pose.pitch --vary pose.yaw,pose.pitch --map 24 --samples 50 --quiet"
    assert main(argv.split()) == 0
    assert given == [
        RegionConfig(
            object="mug", controls={"pose.yaw": {}, "pose.pitch": {}}, vary="pose.yaw,pose.pitch", map=24, samples=50
        )
    ]
    assert capsys.readouterr().out == (
        "The model is wrong in 200 of 200 fresh samples of this box: with 95 % confidence in at least 98.2 % of it.\n\n"
        "The box\n"
        "  parameter   from   to     centre   unit\n"
        "  pose.yaw    10     55.5   30       degrees\n\n"
        "  share of the space   12 %\n"
        "  samples a pixel      64\n"
        "  environment          studio\n"
        "  renders              300\n"
        "  time                 9.0 s\n"
        "  seed                 0\n"
        "  page                 runs/mug-pose-002/report.html\n"
    )


def test_region_takes_scene_and_controls_from_the_run_that_it_goes_around(
    api: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    theirs = AttackConfig(
        object="bowl", controls={"pose": {"yaw": [0, 90]}}, spp=4, seed=7, set_={"camera.azimuth": 20}, run="runs/first"
    )
    with RunDirectory.create_for(theirs):
        pass
    given: list[Any] = []
    api(noting(given, samples.region()))
    assert main("region --around first --vary pose.yaw --seed 9 --quiet".split()) == 0
    (config,) = given
    assert (config.object, config.controls) == ("bowl", {"pose": {"yaw": [0, 90]}})
    assert (config.seed, config.run, config.around, config.set_) == (9, None, "first", {"camera.azimuth": 20.0})


@pytest.mark.parametrize("grid", [True, False])
def test_a_sweep_takes_scene_and_model_from_the_run_whose_adversarial_scene_it_sweeps(
    api: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, grid: bool
) -> None:
    monkeypatch.chdir(tmp_path)
    theirs = AttackConfig(
        object="bowl", environment="noon", set_={"camera.azimuth": 20}, label="bowl", epsilon=0.3, steps=9, spp=4,
        over={"pose": {"yaw": [0, 90]}}, run="runs/first",
    )  # fmt: skip
    with RunDirectory.create_for(theirs):
        pass
    given: list[Any] = []
    api(noting(given, samples.sweep()))
    assert (
        main(
            f"sweep --adversarial-of first --environment dusk {'--grid pose.yaw=0,90' if grid else ''} --quiet".split()
        )
        == 0
    )
    (config,) = given
    assert (config.object, config.environment, config.label, config.set_, config.spp) == (
        "bowl", "dusk", "bowl", {"camera.azimuth": 20.0}, None,
    )  # fmt: skip
    assert config.adversarial_of == "first" and config.run is None
    assert config.controls == ({} if grid else {"pose": {"yaw": [0, 90]}})


def test_region_needs_an_object_or_a_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["region"]) == 2
    assert "advsearch region: expected --object NAME, or --around RUN" in capsys.readouterr().err


def test_sweep_builds_its_configuration_and_passes_its_ending_on(
    api: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    given: list[Any] = []
    api(noting(given, samples.sweep()))
    assert main("sweep --object mug --grid pose.yaw=5:50:8 --grid camera.elevation=10,30 --quiet".split()) == 0
    assert given == [SweepConfig(object="mug", grid={"pose.yaw": "5:50:8", "camera.elevation": [10, 30]})]
    assert capsys.readouterr().out.startswith(
        "The model is right in 6 of 8 configurations (75 %, 95 % interval 35-97 %)."
    )
    api(lambda config, progress, resumed: samples.sweep(ending="interrupted"))
    assert main("sweep --object mug --grid pose.yaw=5:50:8 --json".split()) == 130


@pytest.mark.parametrize(
    ("config", "answer"),
    [
        (AttackConfig(object="mug", steps=9), SUMMARY),
        (AttackConfig(object="mug", epsilon=(0.1, 0.2)), samples.curve()),
        (RegionConfig(object="mug", samples=9), samples.region()),
        (SweepConfig(object="mug", grid={"pose.yaw": [1, 2]}), samples.sweep()),
    ],
    ids=lambda value: value.command if isinstance(value, Config) else "",
)
def test_run_does_what_the_command_of_a_file_says(
    api: Callable[..., None], tmp_path: Path, config: Config, answer: Any
) -> None:
    path = tmp_path / "run.yaml"
    path.write_text(config.to_yaml())
    given: list[Any] = []
    api(noting(given, answer))
    assert main(["run", str(path), "seed=8", "--quiet"]) == 0
    assert given == [config.model_copy(update={"seed": 8})]


# ---- resume, runs, export ----


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with one run that is done and one that was killed."""
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "runs" / "done", pictures=False)
    with RunDirectory.create_for(AttackConfig(object="mug", controls=["pose"], run="killed")) as run:
        yaw: dict[str, Value] = {"pose.yaw": {"value": 12.5, "unit": "degrees"}}
        run.append_rows(Row("search", 0, objective=0.5, success=True, values=yaw), Row("control", 0))
    return tmp_path


@pytest.mark.parametrize(
    ("config", "answer"),
    [
        (AttackConfig(object="mug", run="stopped"), SUMMARY),
        (AttackConfig(object="mug,bowl", run="stopped"), samples.curve()),
        (RegionConfig(object="mug", run="stopped"), samples.region()),
        (SweepConfig(object="mug", grid={"pose.yaw": [1, 2]}, run="stopped"), samples.sweep()),
    ],
    ids=lambda value: value.command if isinstance(value, Config) else "",
)
def test_resume_goes_on_with_what_was_stopped(
    api: Callable[..., None], runs: Path, config: Config, answer: Any
) -> None:
    with RunDirectory.create_for(config) as run:
        run.append_rows(Row("search", 0))
    found: list[Any] = []

    def goes_on(config: Config, *, progress: Progress, resumed: Path | None) -> Any:
        found.append((config.command, resumed))
        return answer

    api(goes_on)
    assert main(["resume", "stopped", "--quiet"]) == 0
    assert found == [(config.command, Path("runs/stopped"))]


def test_resume_of_a_run_that_is_done_shows_its_result(
    api: Callable[..., None], runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    api()
    assert main(["resume", "done"]) == 0
    assert capsys.readouterr() == (text_of(SUMMARY) + "\n", "advsearch: runs/done is done already\n")
    assert main(["resume", "done", "seconds"]) == 2
    assert "seconds" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: None, "unknown run 'gone'. Did you mean 'done'? Known: done, killed. Give a name in runs/"),
        (lambda folder: RunDirectory.create(folder).close(), "expected a run with its run.yaml, got none"),
    ],
)
def test_what_cannot_be_resumed_is_told(
    runs: Path, capsys: pytest.CaptureFixture[str], make: Callable[[Path], None], message: str
) -> None:
    make(Path("runs/gone"))
    assert main(["resume", "gone"]) == 2
    assert message in capsys.readouterr().err


def test_runs_are_listed(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["runs"]) == 0
    assert capsys.readouterr().out == (
        "  run      command   object   controls   rows   state     result\n"
        "  done     attack    mug      texture    80     found     20/20\n"
        "  killed   attack    mug      pose       2      stopped\n"
    )
    assert main(["runs", "runs", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["runs"]
    assert [(one["name"], one["state"], one["rows"]) for one in found] == [
        ("done", "found", 80),
        ("killed", "stopped", 2),
    ]


def test_a_run_over_many_controls_takes_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    many: dict[str, dict[str, object]] = {name: {} for name in ("pose", "camera", "texture", "light", "haze", "lens")}
    with RunDirectory.create_for(AttackConfig(object="mug", controls=many, run=str(tmp_path / "a"))):
        pass
    assert main(["runs", str(tmp_path)]) == 0
    assert "   pose,camera,texture,light and 2 more   " in capsys.readouterr().out


def test_a_run_that_was_stopped_says_how_far_it_came_and_how_to_go_on(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["show", "killed"]) == 0
    assert capsys.readouterr().out == (
        "killed: attack of mug, pose.\n"
        "It was stopped before its end; evaluations kept so far: 1 of control, 1 of search.\n\n"
        "Go on with: advsearch resume killed\n"
    )
    assert main(["show", "killed", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["run"] == "runs/killed" and told["ending"] is None and told["state"] == "stopped"
    assert told["kinds"] == {"control": 1, "search": 1} and told["resume"] == "advsearch resume killed"
    RunDirectory.create("early").close()
    assert main(["show", "early"]) == 0
    assert "It has no run.yaml, so it can't be resumed" in capsys.readouterr().out


def test_an_interrupted_run_says_how_to_go_on(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RunDirectory.resume("killed") as run:
        run.write_summary(samples.attack(ending="interrupted", run="runs/killed"))
    assert main(["show", "killed"]) == 0
    assert capsys.readouterr().out.endswith("\n\nGo on with: advsearch resume killed\n")


def test_no_runs_and_no_folder_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["runs"]) == 0
    assert capsys.readouterr().out == "no runs in runs/ yet; advsearch attack makes one\n"
    assert main(["runs", "elsewhere"]) == 2
    assert "elsewhere: expected a folder with runs in it, got no such folder" in capsys.readouterr().err


def test_export_writes_csv_to_standard_output_and_what_a_file_is_called(
    runs: Path, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    assert main(["export", "killed"]) == 0
    head, first, second = capfdbinary.readouterr().out.decode().splitlines()
    assert head.startswith("id,kind,step,") and "pose.yaw [degrees]" in head.split(",")
    assert first.startswith("1,search,0,") and second.startswith("2,control,0,")
    assert main(["export", "killed", "--json", "--kind", "control"]) == 0
    assert [row["kind"] for row in json.loads(capfdbinary.readouterr().out)] == ["control"]
    assert main(["export", "killed", "--out", "rows.json"]) == 0
    assert capfdbinary.readouterr() == (b"", b"2 rows in rows.json\n")
    assert [row["id"] for row in json.loads(Path("rows.json").read_text())] == [1, 2]
    assert main(["export", "killed", "--out", "rows.txt", "--format", "csv", "--json"]) == 0
    told = json.loads(capfdbinary.readouterr().out)
    assert told == {"schema": 1, "command": "export", "rows": 2, "format": "csv", "out": "rows.txt"}
    assert Path("rows.txt").read_text().splitlines()[0] == head


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["killed", "--format", "xlsx"], "unknown format 'xlsx'."),
        (["killed", "--kind", "serch"], "unknown kind of rows 'serch'. Did you mean 'search'"),
        (["gone"], "unknown run 'gone'."),
        (["killed", "--json", "--format", "csv"], "--json: prints JSON, but --format asks for csv"),
        (["killed", "--out", "runs"], "--out: expected the name of a file, got the folder runs"),
    ],
)
def test_what_cannot_be_exported_is_told(
    runs: Path, capsys: pytest.CaptureFixture[str], argv: list[str], message: str
) -> None:
    assert main(["export", *argv]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(f"advsearch: error: {message}")


# ---- list, show, doctor ----


@pytest.fixture
def registries(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small registries in the place of the real ones."""

    class Pgd:
        """Projected gradient ascent.

        More.
        """

    class Camera:
        """Orbit around the object."""

        parameters = (
            Parameter("azimuth", (), "degrees", -720.0, 720.0, 40.0, "Around.", periodic=True, search=(0.0, 360.0)),
            Parameter("lens", (3,), "name", 0.0, 1.0, "own", "Which.", options=("own", "wide"), estimators=()),
        )
        choices = (Choice("steps", 5, "How many.", whole=(1, 9)),)

    def put(name: str, **attributes: Any) -> None:
        module = types.ModuleType(name)
        vars(module).update(attributes)
        monkeypatch.setitem(sys.modules, name, module)

    put("advsearch.scene.library", list_objects=lambda: ("ball", "mug"), list_environments=lambda: ("studio",))
    put("advsearch.controls", CONTROLS={"camera": Camera()})
    put("advsearch.attacks", POLICIES={"pgd": Pgd})
    put("advsearch.tasks", TASKS={"classification": Pgd})
    put("advsearch.questions.recipe.description", titles=lambda: {"backgrounds": "Which are hard?"})
    put("advsearch.attacks.objectives", objective_summaries=lambda: {"margin": "Largest wrong logit."})


@pytest.mark.usefixtures("registries")
def test_list_names_everything(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == {
        "schema": 1, "objects": ["ball", "mug"], "environments": ["studio"], "controls": ["camera"],
        "policies": ["pgd"], "tasks": ["classification"], "objectives": ["margin"], "models": ["reference"],
        "recipes": ["backgrounds"],
    }  # fmt: skip
    assert main(["list"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("objects:\n  ball\n  mug\n\nenvironments:\n  studio\n")
    assert "policies:\n  pgd   Projected gradient ascent.\n" in out
    assert "objectives:\n  margin   Largest wrong logit.\n" in out
    assert main(["list", "objects"]) == 0
    assert capsys.readouterr().out == "  ball\n  mug\n"


def test_the_listed_models_can_be_loaded_by_that_name() -> None:
    assert list(names.MODELS) == [AttackConfig(object="mug").model]


@pytest.mark.usefixtures("registries")
def test_show_control(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", "control", "camera", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["parameters"][0]["search"] == [0.0, 360.0] and found["parameters"][1]["options"] == ["own", "wide"]
    assert found["choices"][0]["whole"] == [1, 9] and found["choices"][0]["run_setting"] == ""
    assert main(["show", "control", "camera"]) == 0
    assert capsys.readouterr().out == (
        "camera: Orbit around the object.\n\n"
        "parameters, searched or fixed:\n"
        "  name      unit       allowed       searched   default   periodic   moves outlines   "
        "derivative    description\n"
        "  azimuth   degrees    -720 to 720   0 to 360   40        yes        no               differences   Around.\n"
        "  lens      name (3)   own, wide     if asked   own       no         no               none          Which.\n"
        "\nsettings, chosen:\n"
        "  name    allowed   default   description\n"
        "  steps   1 to 9    5         How many.\n"
    )
    assert main(["show", "camera"]) == 2 and "as in: advsearch show control pose" in capsys.readouterr().err
    assert main(["show", "control", "camra"]) == 2
    assert "unknown control 'camra'. Did you mean 'camera'?" in capsys.readouterr().err


def test_show_says_that_rows_may_be_read_from_the_bottom(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", "control", "path"]) == 0
    (rolling,) = [line for line in capsys.readouterr().out.splitlines() if line.split()[:1] == ["rolling"]]
    assert "-60 to 60" in rolling


def test_show_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "runs" / "first", pictures=False, rows=False)
    assert main(["show", "first"]) == 0
    assert capsys.readouterr().out == text_of(SUMMARY) + "\n"
    assert main(["show", "runs/first", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == SUMMARY.to_dict()


@pytest.mark.parametrize(
    ("summary", "first"),
    [
        (samples.curve(), "Still recognised: 3 of 4 at epsilon 0.01."),
        (samples.region(), "The model is wrong in 200 of 200 fresh samples of this box"),
        (samples.sweep(), "The model is right in 6 of 8 configurations"),
    ],
    ids=["curve", "region", "sweep"],
)
def test_show_prints_what_the_command_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], summary: Any, first: str
) -> None:
    with RunDirectory.create(tmp_path / "run") as run:
        run.write_summary(summary)
    assert main(["show", str(tmp_path / "run")]) == 0
    assert capsys.readouterr().out.startswith(first)


@pytest.mark.parametrize("flag", [[], ["--json"]])
def test_doctor_passes_its_status_on(
    flag: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "diagnose", lambda: [doctor.Component("numpy", "", doctor.MISSING)])
    assert main(["doctor", *flag]) == 3
    printed = capsys.readouterr().out
    assert printed.startswith("{") == bool(flag) and "numpy" in printed


# ---- the table ----


def test_the_table_is_read_in_five_seconds() -> None:
    assert text_of(SUMMARY) == (
        "The model calls this mug a vase in 20 of 20 fresh renders (95 % interval 83-100 %).\n\n"
        "                  prediction    probability   rate                95 % interval\n"
        "  clean           mug           98 %          right in 20 of 20   83-100 %\n"
        "  adversarial     vase          91 %          wrong in 20 of 20   83-100 %\n"
        "  random search   40 pictures                 wrong in 1 of 20    0.1-25 %\n\n"
        "  changed   texture within 0.1 (linf: the largest change of any value)\n"
        "  search    pgd, 40 steps: found\n"
        "  renders   40 of the search, 40 gradients, 21 of the verification\n"
        "  time      14.6 s\n"
        "  page      runs/mug-texture-001/report.html"
    )


def test_the_table_says_what_matters_beside_the_verdict() -> None:
    text = text_of(
        samples.attack(
            warnings=["A texture is missing; use `task='depth'`."], baseline={**ATTACK["baseline"], "verified": rated()}
        )
    )
    assert text.endswith("adds nothing here.\n\nNote: A texture is missing; use --task 'depth'.")


def test_the_table_has_the_average_the_bracket_the_target_and_the_conditions() -> None:
    summary = samples.attack(**TARGET, over=["camera"], average=AVERAGE, smallest=BRACKET)
    assert text_of(summary) == (
        "The model calls this mug a vase in 20 of 20 fresh renders (95 % interval 83-100 %), each with another"
        " camera.\n\n"
        "                  prediction           probability   rate                  95 % interval\n"
        "  clean           mug                  98 %          right in 20 of 20     83-100 %\n"
        "  adversarial     vase                 91 %          target in 20 of 20    83-100 %\n"
        "  random search   40 pictures                        target in 1 of 20     0.1-25 %\n"
        "  average case    200 configurations                 right in 150 of 200   68-81 %\n\n"
        "  wanted     the model should predict vase\n"
        "  changed    texture within 0.1 (linf: the largest change of any value)\n"
        "  over       camera, drawn anew for every picture\n"
        "  smallest   0.0123; no search found one at 0.0118\n"
        "  search     pgd, 40 steps: found\n"
        "  renders    40 of the search, 40 gradients, 21 of the verification\n"
        "  time       14.6 s\n"
        "  page       runs/mug-texture-001/report.html"
    )


def test_easier_to_recognise_is_not_called_wrong() -> None:
    text = text_of(samples.attack(**EASIER))
    assert "wanted    easier to recognise\n" in text
    assert "easier in 20 of 20" in text and "wrong in" not in text


def test_a_table_of_almost_nothing() -> None:
    clean = {**ATTACK["clean"], "label": "vase", "probability": None, "control": None}
    text = text_of(samples.attack(ending="already wrong", clean=clean, adversarial=None, verified=None, baseline=None))
    assert text.startswith("The model already calls this mug a vase")
    assert "  clean   vase                       not verified\n" in text


def test_columns() -> None:
    assert align_columns([["a", "bb", "c"], ["aaa", "b"]]) == "  a     bb   c\n  aaa   b"
    assert align_columns([]) == ""


# ---- progress ----


class Clock:
    """Seconds that pass when told."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_lines_come_at_most_every_five_seconds_and_messages_at_once() -> None:
    stream, clock = io.StringIO(), Clock()
    progress = LineProgress(stream, format_as_flags, clock)
    progress.stage("searching", 40, hint="40 pictures; `steps` shortens it", at_most=True)
    for _ in range(12):
        clock.now += 1.0
        progress.advance(best=0.31234)
    progress.message("a warning")
    progress.stage("choosing", 2000, at_most=True)  # of so few, nothing is said of what is left
    for _ in range(8):
        clock.now += 1.0
        progress.advance(4)
    progress.stage("a short one", 3)
    clock.now += 1.0
    progress.advance(3)
    progress.stage("loading the scene")
    for _ in range(8):
        clock.now += 1.0
        progress.tick()
    assert stream.getvalue().splitlines() == [
        "advsearch: searching: 40 pictures; --steps shortens it",
        "advsearch: searching: 7 of at most 40, 7 s, at most 33 s left, best 0.312",
        "advsearch: searching: 12 of at most 40, 12 s, at most 28 s left, best 0.312",
        "advsearch: a warning",
        "advsearch: choosing",
        "advsearch: choosing: 28 of at most 2000, 7 s",
        "advsearch: loading the scene",
        "advsearch: loading the scene: 7 s",
    ]


def test_lines_come_where_nothing_is_counted_too(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setattr("advsearch.progress.ANNOUNCE_SECONDS", 0.0)
    with open_progress(True, format_as_flags) as progress:
        progress.stage("compiling")
        for _ in range(1200):
            if stream.getvalue():
                break
            time.sleep(0.05)
    assert stream.getvalue() == "advsearch: compiling\n"


def test_bars_show_stages_and_the_best() -> None:
    stream = io.StringIO()
    with BarProgress(stream) as progress:
        progress.advance()
        progress.stage("set-up")
        progress.stage("search", 40, hint="40 [small] pictures")
        progress.advance(2, best=0.5, state="[fine]")
        progress.advance()
        progress.message("a [bold] warning")
        progress.stage("verification", 0)
        tasks = progress.bars.tasks
    assert [(task.description, task.completed, task.finished) for task in tasks] == [
        ("set-up", 1, True), ("search", 3, True), ("verification", 0, False),
    ]  # fmt: skip
    assert "a [bold] warning" in stream.getvalue() and "search: 40 [small] pictures" in stream.getvalue()
    assert tasks[1].fields["info"] == "best 0.5, state [fine]"


def test_a_terminal_shows_the_last_stages_with_counts_and_times(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(stream, "isatty", lambda: True)
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "120")
    with open_progress(True, format_as_flags) as progress:
        for number in range(9):
            progress.stage(f"stage {number}")
        progress.stage("searching", 40, hint="`steps` shortens it", at_most=True)
        progress.advance(10, best=0.5)
    shown = stream.getvalue()
    assert "stage 8" in shown and "searching: --steps shortens it" in shown
    assert re.search(r"searching, at most .*10 of 40 .* best 0\.5", re.sub(r"\x1b\[[\d;]*m", "", shown))


def test_a_terminal_shows_the_last_stages_alone() -> None:
    with BarProgress(io.StringIO()) as progress:
        for number in range(9):
            progress.stage(f"stage {number}")
    assert [task.description for task in progress.bars.tasks if task.visible] == [
        f"stage {number}" for number in range(4, 9)
    ]


@pytest.mark.parametrize("argv", [["list"], ["show", "control", "lens"], ["labels"], ["list", "--json"]])
def test_what_loads_much_says_that_it_starts(
    argv: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    begun: list[str] = []
    monkeypatch.setattr(LineProgress, "stage", lambda self, name, *_, **__: begun.append(name))
    assert main(argv) == 0
    assert begun == ["starting: loading PyTorch and Mitsuba"] and capsys.readouterr().out


def test_who_watches(monkeypatch: pytest.MonkeyPatch) -> None:
    def watcher(quiet: bool = False) -> type[Progress]:
        with open_progress(not quiet) as progress:
            progress.stage("search", 3)
            progress.advance(1, best=0.5)
            progress.message("text")
            return type(progress)

    assert watcher() is LineProgress and watcher(quiet=True) is NullProgress
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    assert watcher() is BarProgress and watcher(quiet=True) is NullProgress
