"""`advsearch report`: write the evidence of runs for a model card or a safety case."""

from __future__ import annotations

import argparse
import csv
import math
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from advsearch.cli import output
from advsearch.cli.main import argument, command
from advsearch.extend import InputError

if TYPE_CHECKING:
    from advsearch.questions.report.result import Evidence
NAME = "evidence"
# The file with the camera poses of photographs, and its maximum size in bytes.
POSES = "poses.csv"
MAX_POSES_BYTES = 1 << 20


@command(
    argument(
        "runs",
        nargs="+",
        metavar="RUN",
        help="names or folders of runs; for a recipe, those of its parts",
    ),
    argument(
        "--evidence",
        action="store_true",
        help="write claims, with the evidence that a reader needs to assess them",
    ),
    argument(
        "--criterion",
        metavar="SHARE",
        type=float,
        help="required fraction of right predictions",
    ),
    argument(
        "--exposure",
        metavar="FILE",
        help="YAML file with the frequency of conditions, such as environment: {street: "
        "0.8, noon: 0.2}",
    ),
    argument(
        "--photographs",
        metavar="FOLDER",
        help="photographs aligned with renderings of the first run, by their names: "
        "rendering-12.jpg, "
        "rendering-12-again.jpg; the model of the run evaluates them, and they are "
        "stored in the run",
    ),
    argument(
        "--twins",
        metavar="RUN",
        help="a run of advsearch twins, which measured how well results on renders hold "
        "for photographs",
    ),
    argument(
        "--by",
        metavar="NAME",
        help="name of the responsible person, as it is written in the report",
        default="",
    ),
    argument(
        "--out",
        metavar="FOLDER",
        help="folder for the three files (default: %(default)s)",
        default=NAME,
    ),
    argument("--overwrite", action="store_true", help="replace existing files"),
    output.add_code_flag,
    output.add_json_flag,
    more=": a page, Markdown and JSON",
    examples=(
        "report mug-texture-001 mug-sweep-001 --evidence",
        "report mug-texture-001 mug-sweep-001 --evidence --criterion 0.9 --out card "
        "--json",
    ),
)
def report(args: argparse.Namespace) -> int:
    """Write page, Markdown and JSON about runs, and return the exit status.

    Raises:
        InputError: an argument is wrong, or the folder cannot be made.
    """
    folder = Path(args.out)
    output_paths = [folder / f"{NAME}.{suffix}" for suffix in ("html", "md", "json")]
    _check_arguments(args, output_paths)
    # the claims of all runs; and images by the name of their file
    evidence, images = _collect_evidence(args)
    _make_folder(folder)
    _write_evidence(evidence, images, output_paths)
    text = _format_evidence(evidence, output_paths)
    return output.print_answer(args.json, evidence.to_dict(), text)


def _collect_evidence(args: argparse.Namespace) -> tuple[Evidence, dict[str, bytes]]:
    """Return the claims of the runs, and images by the name of their file.

    Photographs that the arguments name are added to the first run before.

    Args:
        args: arguments of the command.
    """
    # late, so that --help answers at once
    from advsearch.questions.report.evidence import collect_evidence, read_exposure

    exposure = {} if args.exposure is None else read_exposure(args.exposure)
    if args.photographs is not None:
        _add_photographs(args.photographs, args.runs[0])
    return collect_evidence(
        args.runs,
        criterion=args.criterion,
        exposure=exposure,
        by=args.by,
        twins=args.twins,
    )


def _make_folder(folder: Path) -> None:
    """Make the folder for the files, if it does not exist yet.

    Raises:
        InputError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"--out: cannot make the folder {folder}: {error.strerror}"
        ) from None


def _write_evidence(
    evidence: Evidence, images: Mapping[str, bytes], output_paths: Sequence[Path]
) -> None:
    """Write the images, and the claims as a page, as Markdown and as JSON.

    Args:
        evidence: the claims of all runs.
        images: images by the name of their file.
        output_paths: the files for the page, Markdown and JSON, in one folder.
    """
    # late, so that --help answers at once
    from advsearch.extend import directory, writing
    from advsearch.questions.report.result import format_markdown, make_evidence_page

    for name, data in images.items():
        writing.write_bytes(output_paths[0].parent / name, data)
    contents = (
        make_evidence_page(evidence, images),
        format_markdown(evidence),
        directory.summary.to_json(evidence) + "\n",
    )
    for path, content in zip(output_paths, contents, strict=True):
        writing.write_text(path, content)


def _format_evidence(evidence: Any, output_paths: Sequence[Path]) -> str:
    """Return, as text, the claims of all runs, notes and the paths of the files."""
    lines = []
    for run in evidence.runs:
        lines.append(run.run)
        lines += [f"  {claim.kind}: {claim.statement}" for claim in run.claims]
    notes = "".join(f"\nNote: {warning}" for warning in evidence.warnings)
    return "\n".join([*lines, notes, *map(str, output_paths)])


def _check_arguments(args: argparse.Namespace, output_paths: Sequence[Path]) -> None:
    """Check the arguments of `report` before anything is read.

    Args:
        args: arguments of the command.
        output_paths: files that will be written.

    Raises:
        InputError: one is missing or out of range, or a file exists already.
    """
    if not args.evidence:
        raise InputError(
            "report: expected --evidence, which writes the claims of all these runs; "
            "the page of one run is "
            "report.html in its folder"
        )
    _check_no_output(output_paths, overwrite=args.overwrite)
    if args.criterion is not None and not 0.0 < args.criterion <= 1.0:
        raise InputError(
            "--criterion: expected a share over 0 and at most 1, such as "
            f"0.9, got {args.criterion:g}"
        )


def _check_no_output(output_paths: Sequence[Path], *, overwrite: bool) -> None:
    """Check that no file exists already, unless files may be replaced.

    Raises:
        InputError: one exists.
    """
    existing_files = [path for path in output_paths if path.exists()]
    if existing_files and not overwrite:
        raise InputError(
            f"{existing_files[0]}: exists already; add --overwrite or choose "
            "another folder with --out"
        )


def _add_photographs(folder: str, name: str) -> None:
    """Let the model of a run judge photographs, and add them to the run.

    Args:
        folder: folder with photographs. The name of a photograph, or the file `POSES`
            in the folder, states which rendering of the run it shows.
        name: name of the run.

    Raises:
        InputError: there are no photographs, or the rendering of one is not stated.
    """
    from advsearch.extend import directory, settings, workbench  # imports torch

    run = directory.find_run(name)
    # the task determines which files can be photographs
    run_settings = settings.read_yaml(run / directory.CONFIG)
    task: Any = run_settings.get("task") or "classification"
    with tempfile.TemporaryDirectory() as temporary_folder:
        photograph_folder = Path(folder)
        if (photograph_folder / POSES).is_file():
            copies = Path(temporary_folder)
            photograph_folder = _copy_named_by_pose(photograph_folder, run, copies)
        photographs = workbench.load_photographs()
        files = photographs.list_files(photograph_folder, task)
        _check_photographs(files, folder)
        photographs.add_files(run, files)


def _check_photographs(files: Sequence[Path], folder: str) -> None:
    """Check that there are photographs, and that each is matched to a rendering.

    The name of a photograph has the number of its rendering, such as
    "rendering-12.jpg". If the folder has the file `POSES`, the photographs were given
    such names before (`_copy_named_by_pose`).

    Raises:
        InputError: there are no photographs, or one has no number in its name.
    """
    unnumbered_files = [
        file.name for file in files if not file.stem.startswith("rendering-")
    ]
    if unnumbered_files:
        raise InputError(
            f"photographs: {unnumbered_files[0]}: expected the number of a "
            "rendering in its "
            "name, such as rendering-12.jpg, "
            f"or {POSES} in the folder; advsearch dashboard aligns photographs by phone"
        )
    if not files:
        raise InputError(
            f"photographs: {folder}: expected a folder with photographs, got none in it"
        )


def _copy_named_by_pose(folder: Path, run: Path, out: Path) -> Path:
    """Copy photographs, each under the name of the rendering that has its pose.

    Args:
        folder: has the photographs, and a table `POSES` with a line for each: its
            `file`, and the values of the pose, such as `pose.yaw`.
        run: directory of a sweep with exactly one rendering of each pose.
        out: an empty folder.

    Returns:
        The folder `out`, with files such as "rendering-12-photo.jpg".

    Raises:
        InputError: a photograph is missing, or its pose is that of no or several
            renderings.
    """
    # late, so that --help answers at once
    from advsearch.extend import stored_files

    renderings = _read_renderings(run)
    table = stored_files.read_text(folder / POSES, "poses", MAX_POSES_BYTES)
    # line 1 has the heads, so that poses begin on line 2
    for line, pose in enumerate(csv.DictReader(table.splitlines()), 2):
        location = f"photographs: {folder / POSES}, line {line}"
        file = _find_posed_photograph(folder, pose.pop("file", ""), location)
        steps = [step for step, values in renderings if _has_pose(values, pose)]
        _check_single_rendering(steps, location, run, pose)
        shutil.copyfile(file, out / f"rendering-{steps[0]}-{file.name}")
    return out


def _read_renderings(run: Path) -> list[tuple[int, dict[str, Any]]]:
    """Return the number of each rendering of a sweep, and its values by parameter."""
    # late, so that --help answers at once
    from advsearch.extend import Store

    with Store.open_to_read(run) as store:
        return [
            (row.step, {name: value["value"] for name, value in row.values.items()})
            for row in store.rows("sweep")
        ]


def _find_posed_photograph(folder: Path, name: object, location: str) -> Path:
    """Return the photograph that a line of the table of poses names.

    Args:
        folder: folder of the table and the photographs.
        name: the entry in the column "file".
        location: file and line of the pose, for the message.

    Raises:
        InputError: there is no such file.
    """
    # Only the name of the file is used, without its folders: a table cannot name a file
    # outside of the folder.
    file = folder / Path(str(name)).name
    if not file.is_file():
        raise InputError(
            f"{location}: expected the name of a photograph in the same folder "
            f"under `file`, got {file.name!r}"
        )
    return file


def _check_single_rendering(
    steps: Sequence[int], location: str, run: Path, pose: Mapping[str, str | None]
) -> None:
    """Raise an error unless a single rendering of a run has a pose.

    Args:
        steps: numbers of the renderings that have it.
        location: file and line of the pose, for the message.
        run: the run directory.
        pose: texts of the values by name.
    """
    if len(steps) != 1:
        pose_text = ", ".join(f"{name} {text}" for name, text in pose.items())
        raise InputError(
            f"{location}: expected a pose that one rendering of {run.name} has, "
            "got "
            f"{pose_text}, which {len(steps)} have; "
            "sweep a grid of the poses"
        )


def _has_pose(values: Mapping[str, object], pose: Mapping[str, str | None]) -> bool:
    """Return whether a rendering has all values of a pose, whose values are texts."""
    return all(_is_equal_value(values.get(name), text) for name, text in pose.items())


def _is_equal_value(value: object, text: str | None) -> bool:
    """Return whether a text is a value: the same name, or nearly the same number.

    A missing text or a missing value (None) equals nothing.
    """
    if text is None or value is None:
        return False
    if isinstance(value, str):
        return value == text.strip()
    try:
        # the text may be rounded
        return math.isclose(float(str(value)), float(text), rel_tol=1e-3, abs_tol=1e-3)
    except ValueError:
        return False
