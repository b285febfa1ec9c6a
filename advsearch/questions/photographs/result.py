"""How renderings and photographs of the same configurations agree, and the page on
which they are taken.

A rendering is named as its file is: a sweep's by the number of its picture, an attack's
``adversarial``, ``clean`` or ``verification-00``. A photograph comes from a browser, so
nothing in it is believed: it is measured before it is decoded, cut to the rendering's
shape, and written anew without what else its file said (places, names of cameras). The
page lays a rendering, translucent or its edges, over the camera's picture, after the
phone app of 3DB (Leclerc et al. 2021, appendix D).
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageOps
from pydantic import Field

from advsearch.extend import InputError, directory, markup, results, wording

PHOTO = "photo"
LOOSE_PHOTO = "loose photo"
"""Kinds of rows in a run's store: photographs that were aligned with a rendering, and
ones that were with none.
"""


class PhotographedRendering(results.Fields):
    """One rendering, what one model says of it, and of the photographs that were
    aligned with it.
    """

    rendering: str = Field(
        description="its name: the number of a sweep's picture, or "
        "adversarial, clean, ..."
    )
    model: str
    label: str = Field(description="what the model predicts of the rendering")
    rendering_right: bool = Field(description="whether that is right")
    photos: int
    photos_right: int = Field(description="photographs in which the model is right")
    agreeing: int = Field(
        description="photographs that are right where the rendering "
        "is, or wrong where it is"
    )
    interval: results.Interval = Field(
        description="95 % Clopper-Pearson interval of the share that agrees"
    )
    labels: list[str] = Field(
        description="what the model predicts of each photograph, in their order"
    )
    files: list[str] = Field(description="their files in images/photos/, likewise")


class PhotoAgreement(results.Fields):
    """The table of agreement between renderings and reality: counts of photographs,
    each by each model.
    """

    photos: int
    right_right: int = Field(
        description="right in the rendering, right in the photograph"
    )
    right_wrong: int = Field(
        description="right in the rendering, wrong in the photograph"
    )
    wrong_right: int = Field(
        description="wrong in the rendering, right in the photograph"
    )
    wrong_wrong: int = Field(
        description="wrong in the rendering, wrong in the photograph"
    )
    agreement: float | None = Field(
        description="share of the photographs that agree; null where there are none"
    )
    interval: results.Interval | None = Field(
        description="95 % Clopper-Pearson interval of the agreement, as if all "
        "photographs were independent"
    )
    renderings: list[PhotographedRendering]


# of a photograph before it is made smaller; the largest phones take 50 million
MOST_PIXELS = 50_000_000
# longest side in pixels of a photograph that is kept, and of its JPEG file from 1 to 95
SIDE = 1024
QUALITY = 95
_NAME = re.compile(r"[0-9]{1,12}|clean|adversarial|verification-[0-9]{2}")
_PHOTO = re.compile(rf"(?:{_NAME.pattern})-[0-9]{{4,9}}\.jpg")


def rendering_file(run: Path, name: str) -> Path:
    """Return the file of a rendering; an InputError where the run has none of that
    name.
    """
    file = None
    if _NAME.fullmatch(name):
        file = (
            markup.kept_file(run, int(name))
            if name.isdigit()
            else run / directory.IMAGES / f"{name}.png"
        )
    if file is None or not file.is_file():
        raise InputError(
            f"rendering: {run.name} has none called {name[:40]!r}; open "
            "its page for those that it has"
        )
    return file


def rendering_names(run: Path) -> tuple[str, ...]:
    """Return the names of a run's renderings; empty where it kept none."""
    if (kept := markup.kept_pictures(run)) is not None:
        return tuple(map(str, kept.numbers))
    names = [
        file.stem
        for file in (run / directory.IMAGES).glob("*.png")
        if _NAME.fullmatch(file.stem)
    ]
    return tuple(sorted(names, key=lambda name: (name != "adversarial", name)))


def photo_file(run: Path, name: str) -> Path:
    """Return the file of a photograph that was kept; an InputError where there is none
    of that name.
    """
    file = run / directory.PHOTOGRAPHS / name
    if not _PHOTO.fullmatch(name) or not file.is_file():
        raise InputError("photo: there is none of that name")
    return file


def sound_photo(data: bytes, shape: tuple[int, int]) -> bytes:
    """Return a photograph, sent as JPEG, PNG or WebP, as a JPEG of at most `SIDE`
    pixels a side, its middle cut to the ratio of a shape (width, height). An InputError
    where it is too large, or no such picture.
    """
    if len(data) > markup.LARGEST_SENT:
        raise InputError(
            f"photo: expected at most {markup.LARGEST_SENT >> 20} MB, got "
            "more; send a smaller one"
        )
    try:
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "WEBP")) as image:
            if image.width * image.height > MOST_PIXELS:
                raise InputError(
                    f"photo: expected at most {MOST_PIXELS:,} pixels, got "
                    f"{image.width} x {image.height}"
                )
            # a JPEG is decoded at about the size that is needed
            image.draft("RGB", (2 * SIDE, 2 * SIDE))
            upright = ImageOps.exif_transpose(image).convert("RGB")
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise InputError(
            f"photo: expected at most {MOST_PIXELS:,} pixels, got far more"
        ) from None
    except (OSError, SyntaxError, ValueError, EOFError, OverflowError, MemoryError):
        raise InputError(
            "photo: expected a picture in JPEG, PNG or WebP, got "
            "something else or a part"
        ) from None
    shrunk = min(SIDE, max(upright.size)) / max(shape)
    width, height = (max(1, round(side * shrunk)) for side in shape)
    buffer = io.BytesIO()
    ImageOps.fit(upright, (width, height), Image.Resampling.LANCZOS).save(
        buffer, "JPEG", quality=QUALITY
    )
    return buffer.getvalue()


# ---- the page
# -------------------------------------------------------------------------------------------------------


def align_page(
    run: str,
    renderings: Sequence[str],
    table: PhotoAgreement,
    key: str,
    elsewhere: str | None,
) -> str:
    """Return the page of a run as HTML: the first of its renderings is shown, `key` is
    what the server wants to see with a photograph, and `elsewhere` the address by which
    another device opens the page, if one can.
    """
    named = ", ".join(renderings[:8]) + (
        f", ... {renderings[-1]}" if len(renderings) > 8 else ""
    )
    how = (
        "Lay a rendering over what the camera sees, move the real object until both "
        "agree, and take a photograph."
    )
    align = markup.join_html(
        markup.element("p", how),
        markup.element(
            "p",
            f"Renderings of this run ({len(renderings)}): {named}.",
            class_="soft",
            id="renderings",
        ),
        markup.element(
            "noscript",
            markup.element("p", "The camera needs JavaScript, which is switched off."),
        ),
    )
    none = (
        "This run kept no pictures to align with. An attack keeps them when it "
        "ends; a sweep with "
    )
    without = markup.element(
        "p", none, markup.element("code", "keep_pictures=all"), "."
    )
    code = None
    if elsewhere is not None:
        made = markup.qr_code(elsewhere)
        svg = made and markup.Html(
            made.svg_inline(
                omitsize=True, light="#fff", title="QR code of the address below"
            )
        )
        shown = svg or markup.element(
            "p", f"A code to point the phone at would stand here: {markup.NO_QR}"
        )
        summary = markup.element("summary", "Open this page on a phone")
        address = markup.element("pre", elsewhere, class_="wrap", tabindex="0")
        code = markup.element(
            "details", summary, markup.element("div", shown, class_="qr"), address
        )
    main = markup.element(
        "main",
        markup.element("div", align, id="align") if renderings else without,
        markup.element("h2", "Renderings and reality"),
        markup.element("div", table_html(table), id="agreement"),
        code,
    )
    header = markup.element(
        "header",
        markup.element("p", "Photographs", class_="eyebrow"),
        markup.element("h1", f"{run}, photographed"),
    )
    data = (
        [
            markup.data_script(
                {"key": key, "names": list(renderings[:1])}, "photographing"
            )
        ]
        if renderings
        else []
    )
    scripts = ("make.js", "align.js") if renderings else ()
    return markup.document(
        f"{run}, photographs", header, main, data=data, scripts=scripts, connects=True
    )


def table_html(table: PhotoAgreement) -> markup.Html:
    """Return the counts of right and wrong predictions in rendering and photograph, in
    all and by rendering.
    """
    if not table.photos or table.interval is None:
        return markup.element("p", "No photographs yet.", class_="soft")
    counts = [
        ["right in the rendering", str(table.right_right), str(table.right_wrong)],
        ["wrong in the rendering", str(table.wrong_right), str(table.wrong_wrong)],
    ]
    agreeing = table.right_right + table.wrong_wrong
    text = (
        f"They agree in {agreeing} of {wording.count(table.photos, 'photograph')}: "
        f"{wording.percent(table.agreement)}, 95 % interval "
        f"{wording.interval_text(table.interval)}."
    )
    several = len({row.model for row in table.renderings}) > 1
    rows = []
    for row in table.renderings:
        photos = [
            markup.join_html(
                markup.element(
                    "a", label or "nothing", href=f"photos/{markup.in_address(file)}"
                ),
                " ",
            )
            for label, file in zip(row.labels, row.files, strict=True)
        ]
        rendered = f"{'right' if row.rendering_right else 'wrong'}: {row.label}"
        photographed = markup.join_html(
            f"{row.photos_right} of {row.photos} right: ", *photos
        )
        agree = f"{row.agreeing} of {row.photos}", wording.interval_text(row.interval)
        rows.append(
            [
                row.rendering,
                *([row.model] if several else []),
                rendered,
                photographed,
                *agree,
            ]
        )
    heads = [
        "rendering",
        *(["model"] if several else []),
        "in the rendering",
        "in photographs",
        "agree",
        "interval",
    ]
    each = markup.study_table(
        heads,
        rows,
        [f"renderings/{markup.in_address(row.rendering)}" for row in table.renderings],
    )
    counted = ("photographs", "right in the photograph", "wrong in the photograph")
    return markup.join_html(
        markup.element("div", markup.study_table(counted, counts), class_="agreement"),
        markup.element("p", text),
        markup.element(
            "div",
            each,
            class_="scroll",
            tabindex="0",
            role="region",
            aria_label="by rendering",
        ),
    )
