"""Plants forty faults, each alone, in a copy of the checkout, and shows which command
finds it, and by which test.

    python tools/plant.py [NAME ...] [--all-tests] [--list]

A fault is a text that stands exactly once in a file, and what it becomes. The tests
that should find it run until the first failure: first those of `make test`, then those
of `make test-all`. The test that fails has to pass without the fault, or else it does
not count. Where no test finds a fault, one is missing, and the tool ends with 1; also
where `make test` misses more than six. `tests/test_plant.py` holds the list to the
source.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PATIENCE = 900.0
"""Seconds after which tests that do not end have found a fault too."""
SUITES = {
    "make test": "not slow and not docs and not medium",
    "make test-all": "not slow and not docs",
}
"""Markers of the tests that a command runs, the smaller one first."""
MOST_MEDIUM = 6
"""Faults that `make test` may leave to `make test-all`."""


@dataclass(frozen=True)
class Fault:
    """A mistake that anybody could make.

    Attributes:
        name: of the fault; begins with the room.
        file: in which it is, from the root of the checkout.
        before: a text that stands there exactly once.
        after: what comes in its place.
        tests: files, or node ids, of which one should fail.
    """

    name: str
    file: str
    before: str
    after: str
    tests: tuple[str, ...]

    def insert(self, root: Path) -> str:
        """Return the text of the file with the fault in it.

        Raises:
            ValueError: the text before is not there exactly once.
        """
        text = (root / self.file).read_text("utf-8")
        if text.count(self.before) != 1:
            count = text.count(self.before)
            raise ValueError(
                f"{self.name}: expected its text once in {self.file}, got "
                f"{count} times; renew the fault"
            )
        return text.replace(self.before, self.after)


FAULTS = (
    Fault(
        "scene: the exposure is left out",
        "advsearch/scene/formation.py",
        "_SrgbDisplay.apply(radiance, self.gain)",
        "_SrgbDisplay.apply(radiance, 1.0)",
        ("tests/scene/test_renderer.py",),
    ),
    Fault(
        "scene: gradients have the noise of the picture",
        "advsearch/scene/renderer.py",
        'seeds.derive_seed(renderer.root_seed, "gradient", ctx.seed)',
        'seeds.derive_seed(renderer.root_seed, "primal", ctx.seed)',
        ("tests/scene/test_renderer.py",),
    ),
    Fault(
        "mitsuba_backend: the V axis is flipped",
        "advsearch/scene/mitsuba_backend/meshes.py",
        "np.stack([mesh.uvs[:, 0], 1.0 - mesh.uvs[:, 1]], axis=1)",
        "np.stack([mesh.uvs[:, 0], mesh.uvs[:, 1]], axis=1)",
        ("tests/scene/test_emission.py",),
    ),
    Fault(
        "mitsuba_backend: an sRGB colour is taken for a linear one",
        "advsearch/scene/mitsuba_backend/meshes.py",
        '"base_color": make_texture(srgb_to_linear(part.base_color)),',
        '"base_color": make_texture(part.base_color),',
        (
            "tests/controls/test_control_material.py::"
            "test_a_base_colour_is_rendered_as_linear_reflectance",
        ),
    ),
    Fault(
        "importing: a file outside of the folder is read",
        "advsearch/trust/named_files.py",
        "return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))",
        "return True",
        ("tests/scene/test_importing.py",),
    ),
    Fault(
        "importing: the stride of a buffer is ignored",
        "advsearch/scene/importing/gltf.py",
        "row_stride = stride or row_size",
        "row_stride = row_size",
        ("tests/scene/test_gltf.py",),
    ),
    Fault(
        "exporting: normals are flipped",
        "advsearch/scene/glb.py",
        "_y_up(normals)",
        "_y_up(-normals)",
        ("tests/scene/test_normal_maps.py::test_gltf_out_has_the_same_normals",),
    ),
    Fault(
        "exporting: degrees for radians",
        "advsearch/questions/replay/cycles.py",
        '"fov": math.radians(fov),',
        '"fov": fov,',
        ("tests/questions/test_cycles.py",),
    ),
    Fault(
        "controls: the exposure counts twice",
        "advsearch/controls/camera.py",
        'values["exposure"] - scene_exposure',
        'values["exposure"]',
        ("tests/controls/test_clean.py",),
    ),
    Fault(
        "controls: a diameter for a radius",
        "advsearch/controls/light.py",
        'radius = values["size"] / 2.0',
        'radius = values["size"]',
        ("tests/controls/test_control_light.py",),
    ),
    Fault(
        "models: a limit is not applied",
        "advsearch/trust/archives.py",
        "elif unpacked > scale_limit(LARGEST_RATIO) * size + SLACK:",
        "elif unpacked > scale_limit(LARGEST):",
        ("tests/models/test_hostile_models.py",),
    ),
    Fault(
        "models: labels are off by one",
        "advsearch/models/labels.py",
        'stored["coco90"] = stored["coco91"][1:]',
        'stored["coco90"] = stored["coco91"][:-1]',
        ("tests/cli/test_labels.py",),
    ),
    Fault(
        "models: the gradient of all models but the first is lost",
        "advsearch/tasks/together.py",
        "return [model(images) for model in self.models]",
        "return [model(images.detach() if number else images) for number, model in "
        "enumerate(self.models)]",
        ("tests/tasks/test_together.py",),
    ),
    Fault(
        "tasks: a mask is inverted",
        "advsearch/tasks/segmentation.py",
        "selected = output.permute(0, 2, 3, 1)[:, mask]",
        "selected = output.permute(0, 2, 3, 1)[:, ~mask]",
        ("tests/tasks/test_segmentation.py",),
    ),
    Fault(
        "tasks: the axes of a box are swapped",
        "advsearch/tasks/boxes.py",
        "return boxes[..., [1, 0, 3, 2]]",
        "return boxes",
        ("tests/tasks/test_detector_outputs.py",),
    ),
    Fault(
        "attacks: a projection is left out",
        "advsearch/attacks/domain.py",
        "project_l2_box(\n                    u[part], self.start[part], "
        "block.epsilon, block.low, block.high\n                )",
        "u[part].clamp(block.low, block.high)",
        ("tests/attacks/test_attacks_domain.py",),
    ),
    Fault(
        "attacks: an interval has one side",
        "advsearch/statistics/intervals.py",
        "tail = (1.0 - confidence) / 2.0",
        "tail = 1.0 - confidence",
        ("tests/attacks/test_attacks_verification.py",),
    ),
    Fault(
        "attacks: trials of the wrong group count",
        "advsearch/attacks/verification.py",
        "self._is_control_right(clean)",
        "self._is_control_right(adversarial)",
        ("tests/attacks/test_attacks_verification.py",),
    ),
    Fault(
        "policies: every generation has the same noise",
        "advsearch/attacks/policies/evolution.py",
        "seeded(self.seed, self.generation * pairs_per_generation + pair)",
        "seeded(self.seed, pair)",
        ("tests/attacks/policies/test_policy_evolution.py",),
    ),
    Fault(
        "policies: a mean keeps its bias",
        "advsearch/attacks/policies/adam.py",
        "mean = state.direction / (1.0 - self.beta1**state.n_updates)",
        "mean = state.direction",
        ("tests/attacks/policies/test_policy_adam.py",),
    ),
    Fault(
        "engine: a run that goes on evaluates again",
        "advsearch/engine/journal.py",
        "return self._trials_of(query.kind).get(query.row_index)",
        "return None",
        ("tests/engine/test_resume.py",),
    ),
    Fault(
        "engine: answers of workers come as they are done",
        "advsearch/engine/journal.py",
        "index = index_of_item[id(result.items[0])]",
        "index = next_index + len(waiting)",
        ("tests/engine/test_sharing.py",),
    ),
    Fault(
        "sweeps: a rate of another group",
        "advsearch/questions/sweep/result.py",
        "adversarial=count_predictions(adversarial, draws, adversarial_outcome),",
        "adversarial=count_predictions(clean, draws, clean_outcome),",
        ("tests/engine/test_sweep.py",),
    ),
    Fault(
        "runs: two processes may hold a lock",
        "advsearch/trust/writing.py",
        "fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)",
        "fcntl.flock(self._descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)",
        ("tests/engine/test_resume.py", "tests/runs/test_runs.py"),
    ),
    Fault(
        "runs: the last row is dropped",
        "advsearch/runs/store.py",
        "if expected < count:",
        "if expected < count - 1:",
        ("tests/runs/test_runs.py", "tests/engine/test_sweep.py"),
    ),
    Fault(
        "runs: an export has no metrics",
        "advsearch/runs/export.py",
        "return [*LEADING_COLUMNS, *metrics, *values, *TRAILING_COLUMNS]",
        "return [*LEADING_COLUMNS, *values, *TRAILING_COLUMNS]",
        ("tests/runs/test_runs.py",),
    ),
    Fault(
        "report: a page escapes nothing",
        "advsearch/report/views.py",
        "part if isinstance(part, Html) else escape(part)",
        "part",
        ("tests/viewer/test_attack_page.py",),
    ),
    Fault(
        "report: the bleed is printed as a part of the size",
        "advsearch/report/sheets.py",
        "return n_columns * pixel_width, n_rows * pixel_height",
        "return width * pixel_width, height * pixel_height",
        ("tests/report/test_sheets.py",),
    ),
    Fault(
        "viewer: any name leads to the server",
        "advsearch/trust/pages.py",
        "if not _is_server_address(host, listen_host, port, token):",
        "if not host:",
        ("tests/viewer/test_server.py",),
    ),
    Fault(
        "viewer: the best pictures come first",
        "advsearch/viewer/thumbnails.py",
        "np.argsort(np.nan_to_num(margins, nan=np.inf)",
        "np.argsort(-np.nan_to_num(margins, nan=np.inf)",
        ("tests/viewer/test_columns.py",),
    ),
    Fault(
        "cluster: a batch that kills workers is not taken apart",
        "advsearch/cluster/workers.py",
        "if len(items) > 1:",
        "if len(items) > 100:",
        ("tests/cluster/test_workers.py",),
    ),
    Fault(
        "cluster: any version may work",
        "advsearch/cluster/dask_executor.py",
        "if version == workers.compute_version():",
        "if isinstance(version, str):",
        ("tests/cluster/test_executors.py",),
    ),
    Fault(
        "cli: a terminal gets control characters",
        "advsearch/cli/output.py",
        'sign if sign.isprintable() or sign == "\\n" else json.dumps(sign)[1:-1]',
        "sign",
        ("tests/cli/test_hostile_texts.py",),
    ),
    Fault(
        "cli: an interrupted command says that all is well",
        "advsearch/cli/output.py",
        "return INTERRUPTED if was_interrupted else OK",
        "return OK",
        ("tests/cli/test_cli.py",),
    ),
    Fault(
        "config: a default is the other one's",
        "advsearch/questions/attack/settings.py",
        "TRIALS_OVER if self.over else TRIALS",
        "TRIALS if self.over else TRIALS_OVER",
        ("tests/test_config.py",),
    ),
    Fault(
        "explain: a rule is counted on the rows that chose it",
        "advsearch/rules.py",
        "rule = CountedRule(conditions, counting[inside], counting[~inside])",
        "rule = CountedRule(conditions, choosing[find_covered(conditions, choosing)], "
        "choosing)",
        ("tests/questions/test_rules.py",),
    ),
    Fault(
        "explain: what chance adds is not taken off",
        "advsearch/questions/explain/importance.py",
        "1.0 - (1.0 - fraction) * (n_rows - 1) / residual_degrees",
        "fraction",
        ("tests/questions/test_rules.py",),
    ),
    Fault(
        "recipes: right and wrong are mixed up",
        "advsearch/questions/recipe/rates.py",
        "for rendering_is_right in (True, False):\n        for other_is_right in "
        "(True, False):",
        "for other_is_right in (True, False):\n        for rendering_is_right in "
        "(True, False):",
        ("tests/questions/test_recipe.py",),
    ),
    Fault(
        "hardening: what judges is trained on",
        "advsearch/questions/harden/training.py",
        "searched = [copy.copy(lesson) for lesson in validation_items]",
        "searched = list(validation_items)",
        ("tests/questions/test_hardening.py",),
    ),
    Fault(
        "hardening: plain pictures may be lost",
        "advsearch/questions/harden/rounds.py",
        "return clean >= self.finished_rounds[0].clean - self.config.clean_loss - 1e-9",
        "return True",
        ("tests/questions/test_hardening.py",),
    ),
)


@dataclass(frozen=True)
class Outcome:
    """How a run of tests ended.

    Attributes:
        failed: the first test that failed, by its node id; None where none did.
        seconds: that it took.
        is_late: whether the tests did not end.
    """

    failed: str | None
    seconds: float
    is_late: bool = False


class Copy:
    """A copy of the checkout, in which faults are planted one after the other.

    Args:
        folder: where it is made; links stay what they are.

    Attributes:
        root: the folder.
        broken: tests that fail without a fault too, and find nothing.
    """

    def __init__(self, folder: Path) -> None:
        self.root = folder
        self.broken: set[str] = set()
        command = ["git", "ls-files", "-z", "--cached", "--others"]
        listed = subprocess.run(
            [*command, "--exclude-standard"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        )
        for name in listed.stdout.split("\0"):
            if name and os.path.lexists(ROOT / name):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name, follow_symlinks=False)

    def run_tests(self, tests: Sequence[str], marks: str) -> Outcome:
        """Run tests until the first failure, without those that are broken.

        Args:
            tests: files, folders or node ids.
            marks: which of them, as `pytest -m` reads it.

        Raises:
            RuntimeError: pytest could not run them.
        """
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "--tb=no"]
        command += ["-m", marks, *tests]
        for test in self.broken:
            command += ["--deselect", test]
        environment = {**os.environ, "PYTHONPATH": str(self.root)}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        begun = time.perf_counter()
        try:
            ran = subprocess.run(
                command,
                cwd=self.root,
                env=environment,
                capture_output=True,
                text=True,
                timeout=PATIENCE,
            )
        except subprocess.TimeoutExpired:
            return Outcome(None, time.perf_counter() - begun, is_late=True)
        seconds = time.perf_counter() - begun
        if ran.returncode in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
            return Outcome(None, seconds)
        failed = re.search(r"^(?:FAILED|ERROR) (\S+)", ran.stdout, re.MULTILINE)
        if failed is None:
            raise RuntimeError(
                f"pytest ended with {ran.returncode} and no failed "
                f"test:\n{ran.stdout}{ran.stderr}"
            )
        return Outcome(failed[1], seconds)

    def run_with_fault(self, fault: Fault, tests: Sequence[str], marks: str) -> Outcome:
        """Run tests with a fault in the copy, which is as before then."""
        path = self.root / fault.file
        text = path.read_text("utf-8")
        try:
            write_module(path, fault.insert(self.root))
            return self.run_tests(tests, marks)
        finally:
            write_module(path, text)

    def find_test(self, fault: Fault, tests: Sequence[str], marks: str) -> str | None:
        """Return the test that finds a fault, with its seconds; None where none does.

        A test that fails without the fault too does not count.
        """
        while True:
            outcome = self.run_with_fault(fault, tests, marks)
            if outcome.is_late:
                return f"tests that did not end within {PATIENCE:.0f} s"
            if outcome.failed is None:
                return None
            test = outcome.failed.partition("[")[0]
            if self.run_tests([test], marks).failed is None:
                return f"{outcome.failed} ({outcome.seconds:.0f} s)"
            self.broken.add(test)

    def find_suite(
        self, fault: Fault, *, all_tests: bool = False
    ) -> tuple[str, str] | None:
        """Return the smallest command that finds a fault, and by which test; None
        where no command does.

        Args:
            fault: what is planted.
            all_tests: run all tests of a command where those of the fault pass.
        """
        for suite, marks in SUITES.items():
            for tests in (fault.tests, ("tests",)) if all_tests else (fault.tests,):
                test = self.find_test(fault, tests, marks)
                if test is not None:
                    return suite, test
        return None


def write_module(path: Path, text: str) -> None:
    """Write a module, and remove what Python has compiled of it: it goes by the second
    of a change and the length.
    """
    path.write_text(text, "utf-8")
    for old in path.parent.glob(f"__pycache__/{path.stem}.*"):
        old.unlink()


def main(argv: Sequence[str] | None = None) -> int:
    """Plant faults, and return 1 if too many of them were not found."""
    parser = argparse.ArgumentParser(
        prog="python tools/plant.py", description=__doc__.partition("\n")[0]
    )
    parser.add_argument(
        "name",
        nargs="*",
        help="faults, by the beginning of their names, such as scene (default: all)",
    )
    parser.add_argument(
        "--all-tests",
        action="store_true",
        help="run all tests where those that should find it do not",
    )
    parser.add_argument(
        "--list", action="store_true", help="list the faults and plant none"
    )
    args = parser.parse_args(argv)
    chosen = [
        fault
        for fault in FAULTS
        if not args.name or fault.name.startswith(tuple(args.name))
    ]
    if not chosen:
        rooms = dict.fromkeys(fault.name.partition(":")[0] for fault in FAULTS)
        parser.error(f"no fault is called so; the rooms are {', '.join(rooms)}")
    if args.list:
        print("\n".join(f"{fault.name}   ({fault.file})" for fault in chosen))
        return 0

    n_found = dict.fromkeys([*SUITES, "NOT FOUND"], 0)
    with tempfile.TemporaryDirectory(prefix="plant-") as folder:
        copy = Copy(Path(folder))
        for fault in chosen:
            suite, test = copy.find_suite(fault, all_tests=args.all_tests) or (
                "NOT FOUND",
                "no test",
            )
            n_found[suite] += 1
            print(f"{fault.name}: {suite}, {test}", flush=True)
    n_quick, n_medium, n_missed = n_found.values()
    print(
        f"of {len(chosen)} faults make test finds {n_quick}, and make test-all "
        f"{n_quick + n_medium}"
    )
    if copy.broken:
        print(f"These tests fail without a fault too: {', '.join(sorted(copy.broken))}")
    return int(n_missed > 0 or n_medium > MOST_MEDIUM)


if __name__ == "__main__":
    sys.exit(main())
