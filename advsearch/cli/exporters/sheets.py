"""Export a patch or texture as sheets of paper, in a PDF file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from advsearch.extend import Exported, Exporter, Progress, writing

# Longest side, in millimetres, of a printed object whose size is unknown.
USUAL_SIZE = 100.0


class Sheets(Exporter):
    """A patch or texture as sheets to print."""

    name = "print"
    writes = "a PDF file"
    example = "export mug-patch-001 --format print --size 95 --out sheets.pdf"
    suffix = "pdf"
    options = ("size", "sheets", "paper", "icc")

    def write(
        self, run: str, out: Path, options: Mapping[str, Any], progress: Progress
    ) -> Exported:
        """Write the printable pieces of a run as sheets of a PDF file.

        Args:
            run: name or folder of the run.
            out: the PDF file.
            options: values of the flags by name, or None: `size` in millimetres, the
                number of `sheets` at most, `paper`, and the file of an `icc` profile.
            progress: not used.
        """
        from advsearch.extend import exports  # takes seconds

        known_size = options["size"]
        if known_size is None:
            known_size = exports.get_real_size(run)
        # longest side of the object in millimetres
        longest = USUAL_SIZE if known_size is None else known_size
        pieces = exports.make_printable_pieces(run, longest)
        title = f"{Path(run).name}, object of {exports.format_rounded(longest)} mm"
        n_pages = _write_pdf(out, pieces, title, options)
        text = (
            f"{n_pages} pages in {out}; print them at 100 % and measure the square on "
            "the first"
        )
        if known_size is None:
            text += _explain_usual_size(exports.format_rounded(longest))
        facts = {"pages": n_pages, "size_mm": longest, "pieces": _list_sizes(pieces)}
        return Exported(facts, text)


def _explain_usual_size(longest: str) -> str:
    """Return a sentence, on a new line, for an object whose size is not known.

    Args:
        longest: the longest side that is assumed, in millimetres, as text.
    """
    return (
        f"\nThe real object's longest side is taken for {longest} mm; --size says "
        "otherwise."
    )


def _write_pdf(
    out: Path, pieces: Sequence[Any], title: str, options: Mapping[str, Any]
) -> int:
    """Write printable pieces as sheets, and return the number of pages.

    Args:
        out: the PDF file.
        pieces: the pieces.
        title: title of the first sheet.
        options: values of the flags `sheets`, `paper` and `icc`, or None.
    """
    from advsearch.extend import exports  # takes seconds

    profile = None if options["icc"] is None else Path(options["icc"])
    paper = (options["paper"] or "a4").lower()
    max_sheets = options["sheets"]
    if max_sheets is None:
        max_sheets = exports.DEFAULT_MAX_SHEETS
    with writing.name_setting_in_errors("out"), writing.replace_file(out) as part:
        n_pages: int = exports.write_sheets(
            part,
            pieces,
            title,
            paper=paper,
            profile=profile,
            max_sheets=max_sheets,
            make_last_page=exports.draw_chart_page,
        )
    return n_pages


def _list_sizes(pieces: Sequence[Any]) -> list[dict[str, Any]]:
    """Return the name, width and height in millimetres of each printable piece."""
    return [
        {"name": piece.name, "width_mm": piece.size[0], "height_mm": piece.size[1]}
        for piece in pieces
    ]
