"""Readers of images of linear radiance: OpenEXR (.exr) and Radiance (.hdr).

The format of OpenEXR is described in its project's "Technical Introduction to OpenEXR"
and "OpenEXR File Layout". Radiance has shared-exponent RGB, run-length encoded line by
line (Radiance reference manual, "File Formats", Ward 1997). XYZE images are rejected.
Of our dependencies only Mitsuba reads Radiance, and it must not be imported before its
LLVM has been chosen.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import OpenEXR

from advsearch.errors import AdvsearchError, FileFormatError
from advsearch.pictures import MAX_PIXELS, check_pixels
from advsearch.scene.assets import Float32Array, Float64Array
from advsearch.scene.importing.files import damaged, describe_content, format_name
from advsearch.trust.stored_files import check_most

Plane = npt.NDArray[np.floating]
Planes = tuple[Plane, Plane, Plane]
# Limit of the pixels times channels of a file, before `scale_limit`: 8192 x 4096 pixels
# of 4 channels.
MAX_VALUES = 2 * MAX_PIXELS
CHANNEL_NAMES = {
    "r": "R",
    "red": "R",
    "g": "G",
    "green": "G",
    "b": "B",
    "blue": "B",
    "y": "Y",
    "ry": "RY",
    "by": "BY",
}
"""Names of channels, in any case, and what they hold."""
MAIN_LAYER_NAMES = (
    "",
    "rgba",
    "rgb",
    "beauty",
    "combined",
    "color",
    "colour",
    "main",
    "image",
)
"""Names of layers that are the image itself, the likeliest first. Other layers are read
only if no layer has one of these names.
"""
# Defaults of a file, which are those of ITU-R BT.709: weights of red, green and blue,
# and chromaticities (x, y) of the primaries and of white.
LUMINANCE = (0.2126, 0.7152, 0.0722)
PRIMARIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.329)
CUBE_MAP = 1  # value of the attribute "envmap"


@contextlib.contextmanager
def _suppress_output() -> Iterator[None]:
    """Suppress what OpenEXR prints about corrupt files.

    It prints to Python's standard output and to file descriptor 2 of the process.
    """
    with contextlib.ExitStack() as undo:
        undo.enter_context(contextlib.redirect_stdout(io.StringIO()))
        with contextlib.suppress(OSError):  # there may be no error stream
            saved_stream = os.dup(2)
            undo.callback(os.close, saved_stream)
            undo.callback(os.dup2, saved_stream, 2)
            with open(os.devnull, "wb") as null_file:
                os.dup2(null_file.fileno(), 2)
        yield


def read_exr(file: Path, data: bytes) -> tuple[Planes, list[str]]:
    """Read the image of an OpenEXR file.

    If there are several parts and layers, the one whose name means the image itself is
    read, such as "beauty", or else the first one with colors.

    Args:
        file: path of the file, for messages.
        data: its bytes.

    Returns:
        Red, green and blue of its display window, each (H, W) in half or float, black
        where the file has no data; and notes on what is left out, each without the
        name of the file.

    Raises:
        FileFormatError: the file is corrupt, too large, deep, a cube map, or has no
            colors.
    """
    if not data.startswith(b"\x76\x2f\x31\x01"):  # as every OpenEXR file begins
        raise damaged(file, "an OpenEXR picture", describe_content(data))
    header, planes, notes = _read_layer_quietly(file, data)
    _check_no_cube_map(file, header)
    _, size = _read_window(header, "dataWindow")
    _check_planes(file, planes, size)
    colors = planes if "R" in planes else _convert_luminance(planes, size)
    if not _has_srgb_primaries(header):
        notes.append(
            "its colours have other primaries than sRGB, and are read as sRGB colours"
        )
    rgb = (colors["R"], colors["G"], colors["B"])
    return _crop_to_display_window(header, rgb, notes), notes


def _read_layer_quietly(
    file: Path, data: bytes
) -> tuple[dict[str, Any], dict[str, Plane], list[str]]:
    """Return what `_read_layer` returns, without output and with one kind of error.

    Raises:
        FileFormatError: the library cannot read the file, or `_read_layer` raises it.
    """
    try:
        with _suppress_output():
            return _read_layer(file, data)
    except (AdvsearchError, MemoryError):
        raise  # our own errors name the problem already
    except Exception as error:  # the library raises many kinds
        message = (
            f"{file}: cannot be read as OpenEXR; it is damaged or cut short: export it "
            "again"
        )
        raise FileFormatError(message) from error


def _check_no_cube_map(file: Path, header: Mapping[str, Any]) -> None:
    """Raise FileFormatError if a header states that the picture is a cube map."""
    # The library returns a number, or an enum with one as its value.
    environment_map = header.get("envmap")
    if getattr(environment_map, "value", environment_map) == CUBE_MAP:
        raise FileFormatError(
            f"{file}: expected a map of latitude and longitude, got "
            "a cube map; convert it"
        )


def _read_layer(
    file: Path, data: bytes
) -> tuple[dict[str, Any], dict[str, Plane], list[str]]:
    """Return the header, the planes and the notes of the layer that is the image.

    Planes are named by the values of `CHANNEL_NAMES`, such as "R". The file is opened
    twice. The first time only its header is read, to check its size.

    Raises:
        FileFormatError: the image is too large, or has no colors.
        ValueError: the pixels of channels are missing, which the caller reports.
    """
    with OpenEXR.File(
        io.BytesIO(data), separate_channels=True, header_only=True
    ) as exr_file:
        _check_size(file, exr_file)
    with OpenEXR.File(io.BytesIO(data), separate_channels=True) as exr_file:
        parts = [(dict(part.header), dict(part.channels)) for part in exr_file.parts]
        _check_complete(parts)
        header, channels, notes = _select_layer(file, parts)
        planes = {name: channel.pixels for name, channel in channels.items()}
        return header, planes, notes


def _check_complete(parts: list[tuple[dict[str, Any], dict[str, Any]]]) -> None:
    """Raise ValueError unless each part, a header and channels, has all its channels."""
    is_incomplete = any(
        len(channels) != len(header["channels"]) for header, channels in parts
    )
    if not parts or is_incomplete:
        raise ValueError("pixels that end early")


def _check_planes(
    file: Path, planes: Mapping[str, Plane], size: tuple[int, int]
) -> None:
    """Raise FileFormatError unless channels are floats of the size of the image.

    Chroma (RY, BY) may have fewer pixels.

    Args:
        file: path of the file, for messages.
        planes: channels by name, such as "R".
        size: rows and columns of the data window.
    """
    if not _are_floats_of_size(planes, size):
        got = ", ".join(
            f"{name} {plane.dtype} {plane.shape}" for name, plane in planes.items()
        )
        raise FileFormatError(
            f"{file}: expected channels of equal size in half or "
            f"float, got {got}; save it again"
        )


def _are_floats_of_size(planes: Mapping[str, Plane], size: tuple[int, int]) -> bool:
    """Return whether all planes are floats (H, W), and all but chroma have a size."""
    has_size = all(
        plane.shape == size
        for name, plane in planes.items()
        if name not in ("RY", "BY")
    )
    are_floats = all(
        plane.dtype.kind == "f" and plane.ndim == 2 for plane in planes.values()
    )
    return has_size and are_floats


def _has_srgb_primaries(header: Mapping[str, Any]) -> bool:
    """Return whether the primaries of a picture are those of sRGB, as by default."""
    primaries = header.get("chromaticities")
    if primaries is None:
        return True
    primary_values = np.asarray(primaries, np.float64).ravel()
    # Files round them, to three digits for example.
    return bool(np.allclose(primary_values, PRIMARIES, atol=2e-3))


def _check_size(file: Path, picture: Any) -> None:
    """Raise FileFormatError for a picture that is deep, or over a limit.

    There are two limits: one for the number of values of all parts, and one for the
    display window of each part, which may be larger than its data.
    """
    n_values = sum(_count_part_values(file, part.header) for part in picture.parts)
    check_most(
        file,
        n_values,
        MAX_VALUES,
        "OpenEXR pictures of at most {} pixels times channels",
    )


def _count_part_values(file: Path, header: Mapping[str, Any]) -> int:
    """Return the number of values of a part: its pixels times its channels.

    Raises:
        FileFormatError: the part is deep, or its display window is too large.
    """
    if "deep" in str(header.get("type", "")):
        raise FileFormatError(
            f"{file}: expected one value a pixel, got a deep "
            "OpenEXR picture; flatten it"
        )
    _, (data_height, data_width) = _read_window(header, "dataWindow")
    _, (height, width) = _read_window(header, "displayWindow")
    # In a corrupt file the end of a window may be before its start.
    n_pixels = max(data_width, 0) * max(data_height, 0)
    n_values = n_pixels * len(header["channels"])
    check_pixels(file, max(width, 0), max(height, 0))
    return n_values


def _read_window(
    header: Mapping[str, Any], name: str
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the first row and column of a window, and its height and width."""
    low, high = (np.asarray(corner, dtype=np.int64) for corner in header[name])
    width, height = map(int, high - low + 1)
    return (int(low[1]), int(low[0])), (height, width)


class _Layer(NamedTuple):
    """One layer of an OpenEXR file.

    Attributes:
        name: its name, perhaps empty.
        header: header of the part that it is in.
        channels: its channels by what they hold, see `CHANNEL_NAMES`.
    """

    name: str
    header: dict[str, Any]
    channels: dict[str, Any]

    @property
    def rank(self) -> tuple[int, bool]:
        """Rank for the choice of a layer, the lowest first.

        It is the position of the name in `MAIN_LAYER_NAMES`; then a layer with colors
        is before one with luminance.
        """
        last_word = self.name.split(".")[-1].lower()
        name_rank = len(MAIN_LAYER_NAMES)
        if last_word in MAIN_LAYER_NAMES:
            name_rank = MAIN_LAYER_NAMES.index(last_word)
        lacks_colors = "R" not in self.channels
        return name_rank, lacks_colors

    @property
    def color_channels(self) -> dict[str, Any]:
        """Colors, or luminance with its chroma if there is one, by name."""
        names = ("R", "G", "B") if "R" in self.channels else ("Y", "RY", "BY")
        return {name: self.channels[name] for name in names if name in self.channels}


def _select_layer(
    file: Path, parts: list[tuple[dict[str, Any], dict[str, Any]]]
) -> tuple[dict[str, Any], dict[str, Any], list[str]]:
    """Select the layer that is the image.

    It is the layer whose name comes first in `MAIN_LAYER_NAMES`. If several have the
    same rank, or none has such a name, a layer with colors is preferred to one with
    luminance, and then the first one is selected.

    Args:
        file: the file, for messages.
        parts: header and channels of each part.

    Returns:
        Its header, its channels by `CHANNEL_NAMES`, and notes on layers left out.
    """
    layers = _find_color_layers(parts)
    if not layers:
        raise _make_no_colors_error(file, parts)
    selected = min(layers, key=lambda layer: layer.rank)  # the first of equal ones
    notes = _describe_other_layers(selected, layers)
    return selected.header, selected.color_channels, notes


def _make_no_colors_error(
    file: Path, parts: list[tuple[dict[str, Any], dict[str, Any]]]
) -> FileFormatError:
    """Return the error for a file of these parts, none of which has colors."""
    names = sorted({name for _, channels in parts for name in channels})
    got = ", ".join(format_name(name, quoted=False) for name in names)
    expected = "expected the channels R, G and B (or Y alone)"
    return FileFormatError(
        f"{file}: {expected}, got {got}; save the picture as plain RGB"
    )


def _describe_other_layers(selected: _Layer, layers: list[_Layer]) -> list[str]:
    """Return a note on the layers that are left out, as a list of at most one.

    Args:
        selected: the layer that is read.
        layers: all layers with colors.
    """
    other_names = ", ".join(
        format_name(layer.name)
        for layer in layers[:20]  # not more, so that the note stays readable
        if layer.name != selected.name
    )
    if not other_names:
        return []
    if not selected.name:
        return [f"layers are left out: {other_names}"]
    name = format_name(selected.name)
    return [f"of its layers only {name} is read; left out: {other_names}"]


def _find_color_layers(
    parts: list[tuple[dict[str, Any], dict[str, Any]]],
) -> list[_Layer]:
    """Return every layer with color or luminance.

    A channel's name is the name of its layer, a dot, and its content: "diffuse.R". A
    name without a dot belongs to the layer "", which gets the name of its part if the
    file has several parts. A layer is returned if it has R, G and B, or luminance Y,
    alone or with both chroma channels RY and BY. Y together with X or Z is a color of
    XYZ, which is not read.

    Args:
        parts: the header and the channels of each part.
    """
    layers = list[_Layer]()
    for header, channels in parts:
        part_name = str(header.get("name", "")) if len(parts) > 1 else ""
        for layer, layer_channels in _group_channels(channels).items():
            names = set(layer_channels)
            if _is_luminance(names) or {"R", "G", "B"} <= names:
                layers.append(_Layer(layer or part_name, header, layer_channels))
    return layers


def _group_channels(channels: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the channels of each layer, by the layer's name and by what they hold.

    The first of several channels that hold the same is returned.
    """
    channels_by_layer: dict[str, dict[str, Any]] = {}
    for name, channel in channels.items():
        layer, _, channel_name = name.rpartition(".")
        key = CHANNEL_NAMES.get(channel_name.lower(), channel_name)
        channels_by_layer.setdefault(layer, {}).setdefault(key, channel)
    return channels_by_layer


def _is_luminance(names: set[str]) -> bool:
    """Return whether channels are luminance, alone or with both chroma channels."""
    has_both_chromas_or_none = ("RY" in names) == ("BY" in names)
    has_other_colors = bool({"R", "G", "B", "X", "Z"} & names)
    return "Y" in names and has_both_chromas_or_none and not has_other_colors


def _convert_luminance(
    planes: Mapping[str, Plane], size: tuple[int, ...]
) -> dict[str, Plane]:
    """Convert luminance, and chroma if there is any, to red, green and blue.

    RY is (R - Y) / Y and BY is (B - Y) / Y, which give R and B. G follows from Y, the
    weighted mean of the three. Without chroma the image is grey.

    Args:
        planes: luminance "Y", and perhaps chroma "RY" and "BY".
        size: rows and columns of the image; chroma may have fewer, and is interpolated.
    """
    has_chroma = "RY" in planes
    if not has_chroma:
        return dict.fromkeys("RGB", planes["Y"])
    luminance = planes["Y"].astype(np.float32)
    red_ratio = _resample(planes["RY"].astype(np.float32), size)
    blue_ratio = _resample(planes["BY"].astype(np.float32), size)
    red = (red_ratio + 1.0) * luminance
    blue = (blue_ratio + 1.0) * luminance
    green = (luminance - LUMINANCE[0] * red - LUMINANCE[2] * blue) / LUMINANCE[1]
    colors = {"R": red, "G": green, "B": blue}
    return {
        name: np.maximum(plane, 0.0).astype(np.float32)
        for name, plane in colors.items()
    }


def _resample(plane: Plane, size: tuple[int, ...]) -> Plane:
    """Interpolate chroma, which has a value at every n-th row and column, to a size.

    The interpolation is linear along each axis. Beyond the last value, that value is
    repeated.

    Args:
        plane: (h, w) chroma.
        size: rows and columns of the result.
    """
    for axis in (0, 1):
        last_index = plane.shape[axis] - 1
        spacing = round(size[axis] / (last_index + 1))
        position = np.minimum(np.arange(size[axis]) / spacing, last_index)
        lower = position.astype(np.int64)
        upper = np.minimum(lower + 1, last_index)
        # (rows, 1) or (1, columns)
        fraction = np.expand_dims((position - lower).astype(np.float32), 1 - axis)
        plane = (
            plane.take(lower, axis) * (1.0 - fraction)
            + plane.take(upper, axis) * fraction
        )
    return plane


def _shift_ranges(
    rows: range, columns: range, origin: tuple[int, int]
) -> tuple[slice, slice]:
    """Return pixels of a grid as those of an array whose first one is `origin`."""
    first_row, first_column = origin
    return (
        slice(rows.start - first_row, rows.stop - first_row),
        slice(columns.start - first_column, columns.stop - first_column),
    )


def _intersect_ranges(
    data_start: int, data_length: int, start: int, length: int
) -> range:
    """Return what two ranges of integers, each a start and a length, have in common."""
    stop = min(data_start + data_length, start + length)
    return range(max(data_start, start), stop)


def _crop_to_display_window(
    header: Mapping[str, Any], planes: Planes, notes: list[str]
) -> Planes:
    """Crop or pad planes from the data window to the display window.

    Both windows are rectangles in the same grid of pixels: the display window is the
    image, and the data window is where the file has pixels. They may overlap in part.
    Pixels without data are black.

    Args:
        header: the header, which has both windows.
        planes: red, green and blue, of the size of the data window.
        notes: a note about cropped data is added.
    """
    data_corner, data_size = _read_window(header, "dataWindow")
    corner, size = _read_window(header, "displayWindow")
    if data_corner == corner and data_size == size:
        return planes
    rows = _intersect_ranges(data_corner[0], data_size[0], corner[0], size[0])
    columns = _intersect_ranges(data_corner[1], data_size[1], corner[1], size[1])
    if (len(rows), len(columns)) != data_size:
        notes.append("its data beyond the display window is left out")
    red, green, blue = (np.zeros(size, plane.dtype) for plane in planes)
    if rows and columns:
        # the pixels that both windows have, counted from the corner of either one
        source = _shift_ranges(rows, columns, data_corner)
        target = _shift_ranges(rows, columns, corner)
        for plane, cropped in zip(planes, (red, green, blue), strict=True):
            cropped[target] = plane[source]
    return red, green, blue


Bytes = npt.NDArray[np.uint8]
_RESOLUTION = re.compile(
    rb"(?P<line_direction>[-+](?P<line_axis>[YX])) +(?P<n_lines>\d{1,6}) +"
    rb"(?P<pixel_direction>[-+](?P<pixel_axis>[YX])) +(?P<line_length>\d{1,6})\r?\n"
)
"""The direction and number of scanlines, and of the pixels in each: -Y 512 +X 1024."""
_UPRIGHT_DIRECTIONS = (b"-Y", b"+X")
"""Directions of lines, and of the pixels in them, of an image that is not flipped: rows
from top to bottom (y decreases), columns from left to right (x grows). Either may be
the direction of the lines.
"""
_NUMBER = rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def _read_upright_pixels(path: Path, body: bytes) -> Bytes:
    """Return the pixels (H, W, 4) of a Radiance picture, row 0 on top.

    Args:
        path: path of the picture, for messages.
        body: what follows its header: a line with its size, and scanlines.

    Raises:
        FileFormatError: there is no valid size, it is too large, or scanlines are
            missing.
    """
    size_match = _match_size(path, body)
    n_lines = int(size_match["n_lines"])
    line_length = int(size_match["line_length"])
    check_pixels(path, line_length, n_lines)
    pixels = _decode_scanlines(path, body[size_match.end() :], n_lines, line_length)
    return _turn_upright(pixels, size_match)


def _match_size(path: Path, body: bytes) -> re.Match[bytes]:
    """Return the match of `_RESOLUTION` at the beginning of a picture's body.

    Raises:
        FileFormatError: there is no valid size.
    """
    size_match = _RESOLUTION.match(body)
    if (
        not size_match
        or int(size_match["n_lines"]) == 0
        or int(size_match["line_length"]) == 0
        or size_match["line_axis"] == size_match["pixel_axis"]
    ):
        line = body[:30].split(b"\n")[0].decode("latin-1")
        raise FileFormatError(
            f"{path}: expected a size like '-Y 512 +X 1024', got "
            f"{line!r}; save the picture again"
        )
    return size_match


def _turn_upright(pixels: Bytes, size_match: re.Match[bytes]) -> Bytes:
    """Return the pixels (H, W, 4) of scanlines (N, L, 4) with row 0 on top.

    `size_match` has the directions of the lines, and of the pixels in them.
    """
    are_lines_flipped = size_match["line_direction"] not in _UPRIGHT_DIRECTIONS
    if are_lines_flipped:
        pixels = pixels[::-1]
    are_pixels_flipped = size_match["pixel_direction"] not in _UPRIGHT_DIRECTIONS
    if are_pixels_flipped:
        pixels = pixels[:, ::-1]
    if size_match["line_axis"] == b"X":  # its scanlines are columns
        pixels = pixels.transpose(1, 0, 2)
    return pixels


def read_radiance(path: Path, data: bytes) -> tuple[Bytes, Float32Array, list[str]]:
    """Unpack a Radiance RGBE picture.

    Args:
        path: path of the file, for messages.
        data: its bytes.

    Returns:
        Three values. Pixels (H, W, 4) uint8, three mantissas and an exponent, row 0 on
        top; `decode_rgbe` converts them to floats, which take three times the memory.
        Factors (3,) float32 of the linear values, the inverse of all COLORCORR lines.
        Notes on what is left out, each without the name of the file.

    Raises:
        FileFormatError: the file is no Radiance picture, has XYZ colors, is too large,
            or is cut short.
    """
    header, body = _split_header(path, data)
    format_match = re.search(rb"^FORMAT=\s*(\S+)", header, re.MULTILINE)
    if format_match and format_match[1] != b"32-bit_rle_rgbe":
        got = format_name(format_match[1].decode("latin-1"), quoted=False)
        raise FileFormatError(
            f"{path}: expected FORMAT=32-bit_rle_rgbe, got {got}; convert it to RGB"
        )
    pixels = _read_upright_pixels(path, body)
    factors, notes = _read_color_corrections(header)
    return pixels, factors, notes


def _split_header(path: Path, data: bytes) -> tuple[bytes, bytes]:
    """Split a Radiance picture into its header, and the size and scanlines after it.

    Raises:
        FileFormatError: it is no Radiance picture, or has no complete header.
    """
    if not data.startswith(b"#?"):
        raise damaged(path, "a Radiance .hdr picture", describe_content(data))
    header_end = re.search(rb"\r?\n\r?\n", data)  # an empty line
    if not header_end:
        raise damaged(path, "a Radiance .hdr picture", "half a header")
    return data[: header_end.start()], data[header_end.end() :]


def _read_color_corrections(header: bytes) -> tuple[Float32Array, list[str]]:
    """Return the inverse (3,) of all COLORCORR lines, and notes on invalid ones.

    A line has three factors by which the pixels were multiplied. So the original pixels
    are those of the file times the result, which is 1 over the product of all lines. A
    line that would take the result out of float32's range is invalid, too. EXPOSURE
    lines are ignored, since metering sets the exposure.
    """
    factors: Float64Array = np.ones(3)
    notes = list[str]()
    for text in re.findall(rb"^COLORCORR=(.*)$", header, re.MULTILINE)[:100]:
        corrected = _divide_by_correction(factors, text)
        if corrected is not None:
            factors = corrected
        else:
            line = "COLORCORR=" + text.decode("latin-1")
            notes.append(f"its line {format_name(line)} is left out")
    return factors.astype(np.float32), notes


def _divide_by_correction(factors: Float64Array, text: bytes) -> Float64Array | None:
    """Return factors (3,) divided by those of a COLORCORR line; None if it is invalid.

    A valid `text` has three positive numbers, and the result is from 1e-20 to 1e20, far
    within the range of float32.
    """
    numbers = np.array(list(map(float, re.findall(_NUMBER, text)[:4])))
    if len(numbers) != 3 or not (numbers > 0.0).all():
        return None
    corrected: Float64Array = factors / numbers
    is_in_range = ((corrected > 1e-20) & (corrected < 1e20)).all()
    return corrected if is_in_range else None


def decode_rgbe(pixels: Bytes) -> Float32Array:
    """Convert RGBE pixels (H, W, 4) to linear values (H, W, 3) float32.

    A value is mantissa x 2^(exponent - 136), as in Mitsuba: the exponent has a bias of
    128, and the mantissa is in 256ths. An exponent of 0 is black.
    """
    scale = np.ldexp(np.float32(1.0), pixels[:, :, 3].astype(np.int32) - 136)
    scale = np.where(pixels[:, :, 3] == 0, np.float32(0.0), scale)
    return np.ascontiguousarray(
        pixels[:, :, :3].astype(np.float32) * scale[:, :, None], dtype=np.float32
    )


def _decode_scanlines(path: Path, body: bytes, height: int, width: int) -> Bytes:
    """Decode scanlines to pixels (height, width, 4).

    Each line is either run-length encoded or plain. Only lines of 8 to 32767 pixels may
    be encoded.

    Args:
        path: path of the picture, for messages.
        body: the scanlines' bytes.
        height, width: number of scanlines, and of pixels in each.
    """
    result = np.empty((height, width, 4), np.uint8)
    position = 0
    for row in range(height):
        try:
            position = _decode_line(body, position, result[row])
        except (IndexError, ValueError):
            got = (
                f"{row} complete ones and the start of another; the file is cut short "
                "or damaged"
            )
            raise damaged(path, f"{height} scanlines of {width} pixels", got) from None
    return result


def _decode_line(body: bytes, position: int, line: Bytes) -> int:
    """Fill a line (W, 4) from a scanline, run-length encoded or plain.

    Returns:
        The position after the scanline, which begins at `position`.

    Raises:
        IndexError, ValueError: the scanline ends early, or is corrupt.
    """
    width = len(line)
    # two bytes of 2, then the width in two bytes
    run_length_mark = bytes([2, 2, width >> 8 & 0xFF, width & 0xFF])
    has_mark = body[position : position + 4] == run_length_mark
    if 8 <= width < 32768 and has_mark:
        return _decode_runs(body, position + 4, line)
    return _decode_plain_line(body, position, line)


def _decode_runs(body: bytes, position: int, line: Bytes) -> int:
    """Fill a line (W, 4) from its four run-length encoded channels, one by one.

    A run begins with a byte n. If n is above 128, one value follows, which is repeated
    n - 128 times; otherwise n values follow.

    Args:
        body: the scanlines' bytes.
        position: where the runs begin.
        line: the pixels, which are filled in.

    Returns:
        The position after the runs.

    Raises:
        IndexError, ValueError: the runs end early, or do not fit.
    """
    for channel in range(4):
        values, position = _decode_channel(body, position, len(line))
        line[:, channel] = np.frombuffer(values, np.uint8)
    return position


def _decode_channel(body: bytes, position: int, length: int) -> tuple[bytes, int]:
    """Return at least `length` values of the runs of a channel, and the position after.

    Raises IndexError or ValueError if the runs end early, or one has no values.
    """
    runs = []
    n_filled = 0
    while n_filled < length:
        count = body[position]
        if count == 0:
            raise ValueError("a run of length zero")
        if count > 128:  # one value, repeated
            n_bytes = 1
            repeats = count - 128
        else:
            n_bytes = count
            repeats = 1
        runs.append(body[position + 1 : position + 1 + n_bytes] * repeats)
        position = position + 1 + n_bytes
        n_filled = n_filled + n_bytes * repeats
    return b"".join(runs), position


def _decode_plain_line(body: bytes, position: int, line: Bytes) -> int:
    """Fill a line (W, 4) from pixels of four bytes.

    A pixel (1, 1, 1, n) is no color: it repeats the pixel before it n times. If several
    of these follow one another, each next n counts 256 times as much: the second one
    means 256 n times, the third one 65,536 n times.

    Args:
        body: the scanlines' bytes.
        position: where the line begins.
        line: the pixels, which are filled in.

    Returns:
        The position after the line.

    Raises:
        ValueError: a repeat does not fit.
    """
    width = len(line)
    # Usually there are no repeats, and the line is copied at once.
    n_bytes = min(4 * width, len(body) - position)
    line_bytes = np.frombuffer(body, np.uint8, count=n_bytes, offset=position)
    if len(line_bytes) == 4 * width:
        pixels = line_bytes.reshape(width, 4)
        has_repeats = (pixels[:, :3] == 1).all(axis=1).any()
        if not has_repeats:
            line[:] = pixels
            return position + 4 * width
    return _decode_repeats(body, position, line)


def _decode_repeats(body: bytes, position: int, line: Bytes) -> int:
    """Fill a line (W, 4) pixel by pixel, with repeats; see `_decode_plain_line`.

    Returns:
        The position after the line.
    """
    width = len(line)
    n_filled = 0
    count_shift = 0
    while n_filled < width:
        pixel = body[position : position + 4]
        position = position + 4
        if pixel[:3] == b"\x01\x01\x01":
            count = pixel[3] << count_shift
            # There has to be a pixel to repeat, and room for the repeats.
            if n_filled == 0 or n_filled + count > width:
                raise ValueError("a repeat that does not fit")
            line[n_filled : n_filled + count] = line[n_filled - 1]
            n_filled = n_filled + count
            # If the next pixel is a repeat, too, its n counts 256 times as much.
            count_shift = count_shift + 8
        else:
            line[n_filled] = np.frombuffer(pixel, np.uint8)
            n_filled = n_filled + 1
            count_shift = 0
    return position
