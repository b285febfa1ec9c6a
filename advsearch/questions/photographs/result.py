"""The table of agreement between renderings and photographs, and its page.

A rendering has the name of its file: the number of a picture for a sweep, or
``adversarial``, ``clean`` or ``verification-00`` for an attack. A photograph comes from
a browser, so it is not trusted: its size is checked before it is decoded, it is cropped
to the aspect ratio of the rendering, and written again without metadata (coordinates,
names of cameras). The page lays a rendering, translucent or its edges, over the
camera's picture, as the phone app of 3DB does (Leclerc et al. 2021, appendix D).
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
"""Kind of row in a run's store: a photograph that was aligned with a rendering."""
LOOSE_PHOTO = "loose photo"
"""Kind of row in a run's store: a photograph that was aligned with no rendering."""


class PhotographedRendering(results.Fields):
    """Predictions of a model about a rendering and the photographs aligned with it."""

    rendering: str = Field(
        description="name of the rendering: the number of a sweep's picture, or "
        "adversarial, clean, ..."
    )
    model: str
    label: str = Field(description="what the model predicts about the rendering")
    rendering_right: bool = Field(description="whether that prediction is right")
    photos: int
    photos_right: int = Field(
        description="number of photographs in which the model is right"
    )
    agreeing: int = Field(
        description="number of photographs that are right like the rendering, or wrong "
        "like it"
    )
    interval: results.Interval = Field(
        description="95 % Clopper-Pearson interval of the fraction that agrees"
    )
    labels: list[str] = Field(
        description="what the model predicts about each photograph, in their order"
    )
    files: list[str] = Field(
        description="files of the photographs in images/photos/, in the same order"
    )


class PhotoAgreement(results.Fields):
    """Counts of photographs by whether a model is right in them and in the
    rendering.
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
        description="fraction of the photographs that agree; null without photographs"
    )
    interval: results.Interval | None = Field(
        description="95 % Clopper-Pearson interval of the agreement, as if all "
        "photographs were independent"
    )
    renderings: list[PhotographedRendering]


MAX_PIXELS = 50_000_000
"""Maximum number of pixels of a photograph; those of phones have up to 50 million."""
MAX_SIZE = 1024
"""Maximum length in pixels of the longer side of a stored photograph."""
N_NAMED_RENDERINGS = 8
"""Number of renderings that the page names, in addition to the last one."""
JPEG_QUALITY = 95
"""Quality of stored photographs, 1 to 95."""
NO_RENDERINGS = (
    "This run kept no pictures to align with. An attack keeps them when it "
    "ends; a sweep with "
)
INSTRUCTIONS = (
    "Lay a rendering over what the camera sees, move the real object until both "
    "agree, and take a photograph."
)
_NAME = re.compile(r"[0-9]{1,12}|clean|adversarial|verification-[0-9]{2}")
_PHOTO = re.compile(rf"(?:{_NAME.pattern})-[0-9]{{4,9}}\.jpg")


def find_rendering(run: Path, name: str) -> Path:
    """Return the path of the image of a rendering.

    A name comes from a web request, so only names of a fixed pattern are looked up.

    Raises:
        InputError: the run has none of that name.
    """
    file = _locate_rendering(run, name)
    if file is None or not file.is_file():
        raise InputError(
            f"rendering: {run.name} has none called {name[:40]!r}; open "
            "its page for those that it has"
        )
    return file


def _locate_rendering(run: Path, name: str) -> Path | None:
    """Return the path that the image of a rendering has if it exists.

    None if no rendering has a name of this pattern, or a sweep stored none of them.
    """
    if not _NAME.fullmatch(name):
        return None
    is_of_sweep = name.isdecimal()
    if is_of_sweep:
        return markup.find_thumbnail(run, int(name))
    return run / directory.IMAGES / f"{name}.png"


def list_renderings(run: Path) -> tuple[str, ...]:
    """Return the names of a run's renderings; empty if it stored none.

    Those of an attack are in alphabetical order, but "adversarial" comes first.
    """
    stored_images = markup.find_thumbnails(run)  # only a sweep has them
    if stored_images is not None:
        return tuple(map(str, stored_images.numbers))
    names = [
        file.stem
        for file in (run / directory.IMAGES).glob("*.png")
        if _NAME.fullmatch(file.stem)
    ]
    return tuple(sorted(names, key=lambda name: (name != "adversarial", name)))


def find_photo(run: Path, name: str) -> Path:
    """Return the file of a stored photograph.

    Raises:
        InputError: the run has none of that name.
    """
    file = run / directory.PHOTOGRAPHS / name
    if not _PHOTO.fullmatch(name) or not file.is_file():
        raise InputError("photo: there is none of that name")
    return file


def sanitize_photo(data: bytes, shape: tuple[int, int]) -> bytes:
    """Return the center of a photograph as a JPEG without metadata.

    Args:
        data: a file in JPEG, PNG or WebP.
        shape: (width, height) with the aspect ratio to which the photograph is cropped.
            The longer side of the result has at most `MAX_SIZE` pixels.

    Raises:
        InputError: the data is too large, or no image of these formats.
    """
    if len(data) > markup.MAX_BODY_BYTES:
        raise InputError(
            f"photo: expected at most {markup.MAX_BODY_BYTES >> 20} MB, got "
            "more; send a smaller one"
        )
    photo = _decode_photo(data)
    scale = min(MAX_SIZE, max(photo.size)) / max(shape)
    width, height = (max(1, round(length * scale)) for length in shape)
    cut_photo = ImageOps.fit(photo, (width, height), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    cut_photo.save(buffer, "JPEG", quality=JPEG_QUALITY)
    return buffer.getvalue()


def _decode_photo(data: bytes) -> Image.Image:
    """Decode a photograph, upright and in RGB.

    The data comes from a browser and is not trusted, so its size is limited.

    Raises:
        InputError: it has too many pixels, or is no image of a known format.
    """
    try:
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "WEBP")) as image:
            return _decode_upright(image)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise InputError(
            f"photo: expected at most {MAX_PIXELS:,} pixels, got far more"
        ) from None
    except (OSError, SyntaxError, ValueError, EOFError, OverflowError, MemoryError):
        raise InputError(
            "photo: expected a picture in JPEG, PNG or WebP, got "
            "something else or a part"
        ) from None


def _decode_upright(image: Image.Image) -> Image.Image:
    """Decode an opened image, upright and in RGB, unless it has too many pixels."""
    # `open` reads the size without decoding the pixels.
    if image.width * image.height > MAX_PIXELS:
        raise InputError(
            f"photo: expected at most {MAX_PIXELS:,} pixels, got "
            f"{image.width} x {image.height}"
        )
    # A JPEG is decoded at about the size that is needed.
    image.draft("RGB", (2 * MAX_SIZE, 2 * MAX_SIZE))
    # Phones store the direction in EXIF, and not by rotated pixels.
    return ImageOps.exif_transpose(image).convert("RGB")


# ---- the page
# ----------------------------------------------------------------------------------


def make_align_page(
    run: str,
    renderings: Sequence[str],
    table: PhotoAgreement,
    key: str,
    phone_address: str | None,
) -> str:
    """Return the page on which photographs of a run are taken, as HTML.

    Args:
        run: name of the run.
        renderings: names of its renderings. The page begins with the first.
        table: counts of agreement, which stand at the end of the page.
        key: key that the server expects with a photograph.
        phone_address: address by which another device opens the page; None if none can.
    """
    data = []
    scripts: tuple[str, ...] = ()
    if renderings:
        # The script takes a list, of the renderings to lay over the camera's image.
        page_data = {"key": key, "names": [renderings[0]]}
        data = [markup.make_data_script(page_data, "photographing")]
        scripts = ("make.js", "align.js")
    # `connects` lets the script send the photograph to the server.
    return markup.make_document(
        f"{run}, photographs",
        _make_align_header(run),
        _make_main(renderings, table, phone_address),
        data=data,
        scripts=scripts,
        connects=True,
    )


def _make_align_header(run: str) -> markup.Html:
    """Make the header of the page on which photographs of a run are taken."""
    return markup.make_element(
        "header",
        markup.make_element("p", "Photographs", class_="eyebrow"),
        markup.make_element("h1", f"{run}, photographed"),
    )


def _make_main(
    renderings: Sequence[str], table: PhotoAgreement, phone_address: str | None
) -> markup.Html:
    """Return the content of the page: the camera, the agreement, and the address."""
    return markup.make_element(
        "main",
        _align_section(renderings),
        markup.make_element("h2", "Renderings and reality"),
        markup.make_element("div", make_agreement_table(table), id="agreement"),
        None if phone_address is None else _phone_section(phone_address),
    )


def _align_section(renderings: Sequence[str]) -> markup.Html:
    """Return the section with the camera image and a rendering over it.

    Without renderings it states why there are none. The script of the page fills the
    element "align".
    """
    if not renderings:
        return markup.make_element(
            "p", NO_RENDERINGS, markup.make_element("code", "keep_pictures=all"), "."
        )
    no_script = markup.make_element(
        "p", "The camera needs JavaScript, which is switched off."
    )
    content = markup.join_html(
        markup.make_element("p", INSTRUCTIONS),
        _make_names_element(renderings),
        markup.make_element("noscript", no_script),
    )
    return markup.make_element("div", content, id="align")


def _make_names_element(renderings: Sequence[str]) -> markup.Html:
    """Return a paragraph with the names of the first renderings and of the last one."""
    names = ", ".join(renderings[:N_NAMED_RENDERINGS])
    if len(renderings) > N_NAMED_RENDERINGS:
        names += f", ... {renderings[-1]}"
    return markup.make_element(
        "p",
        f"Renderings of this run ({len(renderings)}): {names}.",
        class_="soft",
        id="renderings",
    )


def _phone_section(address: str) -> markup.Html:
    """Return an address and its QR code, by which a phone opens the page."""
    return markup.make_element(
        "details",
        markup.make_element("summary", "Open this page on a phone"),
        markup.make_element("div", _make_qr_element(address), class_="qr"),
        markup.make_element("pre", address, class_="wrap", tabindex="0"),
    )


def _make_qr_element(address: str) -> markup.Html:
    """Return the QR code of an address; without the package for it, a sentence."""
    code = markup.make_qr_code(address)
    if code:
        title = "QR code of the address below"
        return markup.Html(code.svg_inline(omitsize=True, light="#fff", title=title))
    return markup.make_element(
        "p", f"A code to point the phone at would stand here: {markup.NO_QR}"
    )


def make_agreement_table(table: PhotoAgreement) -> markup.Html:
    """Return the counts of right and wrong predictions, in all and by rendering.

    Args:
        table: counts of agreement.
    """
    if not table.photos or table.interval is None:
        return markup.make_element("p", "No photographs yet.", class_="soft")
    by_rendering = markup.make_element(
        "div",
        _rendering_table(table.renderings),
        class_="scroll",
        tabindex="0",
        role="region",
        aria_label="by rendering",
    )
    return markup.join_html(
        markup.make_element("div", _make_outcome_table(table), class_="agreement"),
        markup.make_element("p", _describe_photo_agreement(table)),
        by_rendering,
    )


def _make_outcome_table(table: PhotoAgreement) -> markup.Html:
    """Make the table of how many photographs and renderings are right and wrong."""
    heads = ("photographs", "right in the photograph", "wrong in the photograph")
    counts = [
        ["right in the rendering", str(table.right_right), str(table.right_wrong)],
        ["wrong in the rendering", str(table.wrong_right), str(table.wrong_wrong)],
    ]
    return markup.make_table(heads, counts)


def _describe_photo_agreement(table: PhotoAgreement) -> str:
    """Describe in how many photographs predictions agree; there is at least one."""
    assert table.interval is not None
    n_agreeing = table.right_right + table.wrong_wrong
    return (
        f"They agree in {n_agreeing} of {wording.format_count(table.photos, 'photograph')}: "
        f"{wording.percent(table.agreement)}, 95 % interval "
        f"{wording.format_interval(table.interval)}."
    )


def _rendering_table(renderings: Sequence[PhotographedRendering]) -> markup.Html:
    """Return the table of agreement by rendering, with models if there are several.

    Args:
        renderings: counts of each rendering and model.
    """
    has_models = len({rendering.model for rendering in renderings}) > 1
    heads = [
        "rendering",
        *(["model"] if has_models else []),
        "in the rendering",
        "in photographs",
        "agree",
        "interval",
    ]
    rows = [_make_rendering_row(rendering, has_models) for rendering in renderings]
    addresses = [
        f"renderings/{markup.quote_name(rendering.rendering)}"
        for rendering in renderings
    ]
    return markup.make_table(heads, rows, addresses)


def _make_rendering_row(
    rendering: PhotographedRendering, has_models: bool
) -> list[str]:
    """Return the cells of a rendering; the model is the second if the table has it."""
    outcome = "right" if rendering.rendering_right else "wrong"
    return [
        rendering.rendering,
        *([rendering.model] if has_models else []),
        f"{outcome}: {rendering.label}",
        _photographs_cell(rendering),
        f"{rendering.agreeing} of {rendering.photos}",
        wording.format_interval(rendering.interval),
    ]


def _photographs_cell(rendering: PhotographedRendering) -> markup.Html:
    """Return in how many photographs the model is right, with a link to each.

    The text of a link is what the model predicts about the photograph.
    """
    links = []
    for label, file in zip(rendering.labels, rendering.files, strict=True):
        address = f"photos/{markup.quote_name(file)}"
        link = markup.make_element("a", label or "nothing", href=address)
        links.append(markup.join_html(link, " "))
    return markup.join_html(
        f"{rendering.photos_right} of {rendering.photos} right: ", *links
    )
