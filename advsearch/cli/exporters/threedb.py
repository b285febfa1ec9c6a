"""A sweep as a folder of 3DB (Leclerc et al. 2021), for its dashboard.

`details.log` has a JSON object a line, `class_maps.json` the names of classes, and
``images/<id>_rgb.png`` the images. `advsearch.runs.export.read_threedb` reads such a
folder.
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
PLACED = ("environment", "object")  # values that have a place of their own in a line


def write_threedb(
    rows: Callable[[], Iterable[Any]], out: Path, picture: Callable[[int], bytes | None]
) -> int:
    """Write the rows of a sweep as a folder of 3DB, with the PNG of each where one was
    kept, and return how many there were.

    Args:
        rows: returns the rows; it is called twice, since all names have to be known
            first.
        out: the folder, which is made, or empty.
        picture: returns the PNG of a row by its step, None if none was kept.

    Raises:
        InputError: there are no rows, or the folder is not empty.
    """
    writing.check_free_folder(out, "out")
    # parameters, in the order in which rows have them; a dict is an ordered set
    names = dict[str, None]()
    # index of each predicted class by its label; None where the model has no index
    classes = dict[str, int | None]()
    for row in rows():
        names |= dict.fromkeys(name for name in row.values if name not in PLACED)
        classes.setdefault(row.label or Store.NOT_A_NUMBER, row.label_index)
    if not classes:
        raise InputError("format 3db: needs the rows of a sweep, and this run has none")
    class_index = {name: index for name, index in classes.items() if index is not None}
    for name in classes:  # those without an index come behind the others
        if name not in class_index:
            class_index[name] = max(class_index.values(), default=-1) + 1
    class_by_index = {index: name for name, index in class_index.items()}
    with writing.name_setting_in_errors("out"):
        n_rows = 0
        with (
            writing.replace_file(out / DETAILS) as part,
            part.open("w", encoding="utf-8") as file,
        ):
            for row in rows():
                prediction = class_index[row.label or Store.NOT_A_NUMBER]
                line = make_line(row, names, prediction)
                file.write(json.dumps(line, allow_nan=False) + "\n")
                data = picture(row.step)
                if data is not None:
                    writing.write_bytes(
                        out / IMAGES / f"{line['id']}_rgb.png", data, durable=False
                    )
                n_rows += 1
        # a list by index, in which gaps get a name
        class_names = [
            class_by_index.get(index, f"class {index}")
            for index in range(max(class_by_index) + 1)
        ]
        writing.write_text(out / CLASSES, json.dumps(class_names))
    return n_rows


def make_line(row: Any, names: Iterable[str], prediction: int) -> dict[str, Any]:
    """Return one line of a 3DB log, for a row of a sweep.

    3DB minimizes where we maximize, so its loss is the negative margin: over 0 where a
    prediction is wrong.

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
    environment, model = (str(value_of.get(name, "none")) for name in PLACED)
    return {
        "id": f"{row.step}",
        "environment": environment,
        "model": model,
        "is_correct": str(bool(row.correct)),
        # 0.0 minus the margin, since -0.0 would be written as such
        "loss": None if row.margin is None else 0.0 - row.margin,
        "prediction": [prediction],
        "output_type": "classes",
        "render_args": parameters,
    }


class ThreeDB(Exporter):
    """A sweep as a folder for 3DB's dashboard."""

    name = "3db"
    writes = "a folder"
    example = "export mug-sweep-001 --format 3db --out folder"
    options = ("kind",)

    def write(
        self, run: str, out: Path, options: Mapping[str, Any], progress: Progress
    ) -> Exported:
        """See `Exporter.write`."""
        from advsearch.extend import exports  # takes seconds

        run_path = directory.find_run(run)
        thumbnails = exports.thumbnails.find_thumbnails(run_path)
        with Store(run_path / Store.FILE, read_only=True) as store:
            read_picture = thumbnails.read_png if thumbnails else lambda _: None
            n_rows = write_threedb(
                lambda: store.rows(options["kind"] or "sweep"), out, read_picture
            )
        return Exported(
            {"rows": n_rows},
            f"{n_rows} rows in {out}; look at them with: python -m threedboard {out}",
        )
