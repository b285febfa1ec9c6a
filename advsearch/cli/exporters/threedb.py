"""Export a sweep as a folder of 3DB (Leclerc et al. 2021), for the dashboard of 3DB.

The folder contains `details.log` with a JSON object in each line, `class_maps.json`
with the names of the classes, and the images as ``images/<id>_rgb.png``.
`advsearch.runs.export.read_threedb` reads such a folder.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from advsearch.extend import (
    Exported,
    Exporter,
    InputError,
    Progress,
    Store,
    directory,
    writing,
)

DETAILS = "details.log"
CLASSES = "class_maps.json"
IMAGES = "images"
# Values that have a key of their own in a line of `details.log`.
SEPARATE_VALUES = ("environment", "object")


def write_threedb(
    iterate_rows: Callable[[], Iterable[Any]],
    out: Path,
    read_picture: Callable[[int], bytes | None],
) -> int:
    """Write the rows of a sweep as a folder of 3DB, and return how many there were.

    Args:
        iterate_rows: returns the rows. It is called twice: every line has the names of
            all parameters, which are known after all rows.
        out: the folder, which is made, or empty.
        read_picture: returns the PNG of a row by its step; None if it has none.

    Raises:
        InputError: there are no rows, or the folder is not empty.
    """
    writing.check_free_folder(out, "out")
    names, class_index = _collect_names(iterate_rows())
    n_rows = 0
    with writing.name_setting_in_errors("out"):
        with (
            writing.replace_file(out / DETAILS) as part,
            part.open("w", encoding="utf-8") as file,
        ):
            for row in iterate_rows():
                line = make_line(row, names, class_index[_get_label(row)])
                file.write(json.dumps(line, allow_nan=False) + "\n")
                _write_picture(out, line["id"], read_picture(row.step))
                n_rows += 1
        class_names = _list_class_names(class_index)
        writing.write_text(out / CLASSES, json.dumps(class_names))
    return n_rows


def _collect_names(rows: Iterable[Any]) -> tuple[list[str], dict[str, int]]:
    """Return the names of the parameters of rows, and the index of each label.

    Args:
        rows: rows of a sweep.

    Raises:
        InputError: there are no rows.
    """
    # the parameters in the order in which rows have them; a dict is an ordered set
    names = dict[str, None]()
    # index of each predicted label; None where the model has no index for it
    index_of_label = dict[str, int | None]()
    for row in rows:
        names |= dict.fromkeys(
            name for name in row.values if name not in SEPARATE_VALUES
        )
        index_of_label.setdefault(_get_label(row), row.label_index)
    if not index_of_label:
        raise InputError("format 3db: needs the rows of a sweep, and this run has none")
    return list(names), _complete_indices(index_of_label)


def _write_picture(out: Path, line_id: str, png: bytes | None) -> None:
    """Write the picture of a line into the folder of 3DB; None if it has none."""
    if png is not None:
        image_path = out / IMAGES / f"{line_id}_rgb.png"
        writing.write_bytes(image_path, png, durable=False)


def _get_label(row: Any) -> str:
    """Return the predicted label of a row, also of an output that is not a number."""
    return row.label or Store.NOT_A_NUMBER


def _complete_indices(index_of_label: Mapping[str, int | None]) -> dict[str, int]:
    """Return the index of each label; labels without one get the next free indices."""
    class_index = {
        label: index for label, index in index_of_label.items() if index is not None
    }
    for label in index_of_label:
        if label not in class_index:
            class_index[label] = max(class_index.values(), default=-1) + 1
    return class_index


def _list_class_names(class_index: Mapping[str, int]) -> list[str]:
    """Return the class names by index; an index that no label has gets a name too."""
    label_of_index = {index: label for label, index in class_index.items()}
    return [
        label_of_index.get(index, f"class {index}")
        for index in range(max(label_of_index) + 1)
    ]


def make_line(row: Any, names: Iterable[str], prediction: int) -> dict[str, Any]:
    """Return one line of a 3DB log, for a row of a sweep.

    The loss of a line is the negative margin: it is positive if a prediction is wrong.

    Args:
        row: row of the results.
        names: parameters that every line has; one that the row lacks is "none". The
            model is called "network" here, since 3DB's "model" is the object.
        prediction: index of the predicted class.
    """
    value_of = {name: entry["value"] for name, entry in row.values.items()}
    parameters = {
        "network" if name == "model" else name: value_of.get(name, "none")
        for name in names
    }
    # 0.0 minus the margin: the negative of 0.0 would be written as -0.0
    loss = None if row.margin is None else 0.0 - row.margin
    return {
        "id": f"{row.step}",
        "environment": str(value_of.get("environment", "none")),
        "model": str(value_of.get("object", "none")),
        "is_correct": str(bool(row.correct)),
        "loss": loss,
        "prediction": [prediction],
        "output_type": "classes",
        "render_args": parameters,
    }


def _read_no_picture(step: int) -> bytes | None:
    """Return None, for a run without small pictures."""
    return None


class ThreeDB(Exporter):
    """A sweep as a folder for 3DB's dashboard."""

    name = "3db"
    writes = "a folder"
    example = "export mug-sweep-001 --format 3db --out folder"
    options = ("kind",)

    def write(
        self, run: str, out: Path, options: Mapping[str, Any], progress: Progress
    ) -> Exported:
        """Write the rows of a run as a folder of 3DB.

        Args:
            run: name or folder of the run.
            out: the folder, which is made, or empty.
            options: `kind` of the rows; None stands for those of a sweep.
            progress: not used.
        """
        from advsearch.extend import exports  # takes seconds

        run_path = directory.find_run(run)
        thumbnails = exports.thumbnails.find_thumbnails(run_path)
        read_picture = thumbnails.read_png if thumbnails else _read_no_picture
        kind = options["kind"] or "sweep"
        with Store(run_path / Store.FILE, read_only=True) as store:
            n_rows = write_threedb(lambda: store.rows(kind), out, read_picture)
        text = f"{n_rows} rows in {out}; look at them with: python -m threedboard {out}"
        return Exported({"rows": n_rows}, text)
