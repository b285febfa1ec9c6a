"""Environments from .hdr and .exr pictures: values, sizes, and every error that a file can cause."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

import conftest
from advsearch.errors import FileFormatError, InputError
from advsearch.scene.library import import_environment
from fuzz.pictures import exr

DATA = conftest.DATA / "environments"
real_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"the shared test data is not at {DATA}")

HEADER = b"#?RADIANCE\n# made by hand\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\n\n"


def write_exr(path: Path, channels: dict[str, np.ndarray]) -> Path:
    """Write an OpenEXR file and return its path."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(path))
    return path


def light(height: int = 8, width: int = 16) -> np.ndarray:
    """Return random radiance, (height, width, 3) float32 in [0, 4)."""
    return np.random.default_rng(0).random((height, width, 3), dtype=np.float32) * 4


def rgbe(height: int, width: int) -> np.ndarray:
    """Return random shared-exponent pixels with runs in them, (height, width, 4) uint8."""
    pixels = np.random.default_rng(0).integers(2, 256, (height, width, 4), dtype=np.uint8)
    pixels[:, width // 3 : width // 2] = [200, 100, 50, 129]
    pixels[0, 0] = [9, 9, 9, 0]  # exponent 0 is black
    pixels[:, :, 3] = np.where(pixels[:, :, 3] == 0, 0, 120 + pixels[:, :, 3] % 16)
    pixels[0, 0, 3] = 0
    return pixels


def values(pixels: np.ndarray) -> np.ndarray:
    """Return what shared-exponent pixels mean."""
    scale = np.where(pixels[..., 3:] == 0, 0.0, 2.0 ** (pixels[..., 3:].astype(np.float64) - 136))
    return (pixels[..., :3] * scale).astype(np.float32)


def run_lengths(pixels: np.ndarray) -> bytes:
    """Encode pixels line by line with the four channels apart, in runs and literal stretches."""
    body = b""
    for line in pixels:
        body += bytes([2, 2, len(line) >> 8, len(line) & 255])
        for channel in line.T:
            at = 0
            while at < len(channel):
                run = 1
                while at + run < len(channel) and run < 127 and channel[at + run] == channel[at]:
                    run += 1
                if run > 2:
                    body += bytes([128 + run, channel[at]])
                    at += run
                else:
                    stretch = channel[at : at + 5]
                    body += bytes([len(stretch), *stretch])
                    at += len(stretch)
    return body


def repeats(pixels: np.ndarray) -> bytes:
    """Encode pixels in the old way: each as four bytes, repeats as (1, 1, 1, count)."""
    body = b""
    for line in pixels:
        at = 0
        while at < len(line):
            run = 1
            while at + run < len(line) and run < 300 and (line[at + run] == line[at]).all():
                run += 1
            body += bytes(line[at])
            if run > 1:
                low, high = (run - 1) & 255, (run - 1) >> 8
                body += bytes([1, 1, 1, low]) + (bytes([1, 1, 1, high]) if high else b"")
            at += run
    return body


def write_hdr(path: Path, pixels: np.ndarray, encode: Callable[[np.ndarray], bytes], size: bytes = b"") -> Path:
    """Write a Radiance file and return its path."""
    size = size or b"-Y %d +X %d\n" % pixels.shape[:2]
    path.write_bytes(HEADER + size + encode(pixels))
    return path


@pytest.mark.parametrize("encode", [run_lengths, repeats, np.ndarray.tobytes], ids=["runs", "repeats", "plain"])
def test_radiance_encodings(tmp_path: Path, encode: Callable[[np.ndarray], bytes]) -> None:
    pixels = rgbe(12, 24)
    got = import_environment(write_hdr(tmp_path / "sky.hdr", pixels, encode))
    assert got.name == "sky" and got.source.endswith("sky.hdr") and got.warnings == ()
    assert got.radiance.dtype == np.float32
    assert np.array_equal(got.radiance, values(pixels))
    assert got.radiance[0, 0].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("size", [b"+Y 12 +X 24\n", b"-Y 12 -X 24\n", b"+X 24 -Y 12\n", b"-X 24 +Y 12\n"])
def test_radiance_orientation_by_rows_and_by_columns(tmp_path: Path, size: bytes) -> None:
    pixels = rgbe(12, 24)
    seen = pixels[:: -1 if b"+Y" in size else 1, :: -1 if b"-X" in size else 1]
    stored = seen.transpose(1, 0, 2) if b"X" in size[:2] else seen
    got = import_environment(write_hdr(tmp_path / "sky.hdr", stored, run_lengths, size))
    assert np.array_equal(got.radiance, values(pixels))


def test_what_a_radiance_header_multiplied_is_undone(tmp_path: Path) -> None:
    """Of colours; exposure is metered, so that its line says nothing."""
    pixels = rgbe(12, 24)
    path = write_hdr(tmp_path / "sky.hdr", pixels, run_lengths)
    path.write_bytes(path.read_bytes().replace(b"EXPOSURE=2", b"EXPOSURE=2\nCOLORCORR= 1 2 0.5\nCOLORCORR=0 1 1"))
    got = import_environment(path)
    np.testing.assert_allclose(got.radiance, values(pixels) / np.array([1.0, 2.0, 0.5], np.float32), rtol=1e-6)
    assert len(got.warnings) == 1 and "COLORCORR" in got.warnings[0]


def planes(image: np.ndarray, layer: str = "") -> dict[str, np.ndarray]:
    """The channels of an image (H, W, 3) in a layer."""
    prefix = f"{layer}." if layer else ""
    return {f"{prefix}{name}": np.ascontiguousarray(image[:, :, k]) for k, name in enumerate("RGB")}


def window(left: int, top: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """A window as an OpenEXR header has it."""
    return np.array([left, top], np.int32), np.array([left + width - 1, top + height - 1], np.int32)


@pytest.mark.parametrize(("left", "top"), [(5, 2), (-3, -1), (100, 0)])
def test_an_exr_shows_its_display_window(tmp_path: Path, left: int, top: int) -> None:
    """Which is black where there is no data, and data beyond it is left out, and said."""
    image, whole = light(4, 8), np.zeros((8, 16, 3), np.float32)
    inside = image[max(-top, 0) :, max(-left, 0) :]
    if left < 16:
        whole[max(top, 0) : max(top, 0) + len(inside), max(left, 0) : max(left, 0) + inside.shape[1]] = inside
    header = {"dataWindow": window(left, top, 8, 4), "displayWindow": window(0, 0, 16, 8)}
    OpenEXR.File(header, planes(image)).write(str(tmp_path / "room.exr"))
    got = import_environment(tmp_path / "room.exr")
    assert np.array_equal(got.radiance, whole)
    assert any("beyond the display window" in one for one in got.warnings) == (left != 5)


@pytest.mark.parametrize(
    "parts",
    [
        [("depth", {"Z": light()[:, :, 0].copy()}), ("rgba", planes(light()))],
        [("diffuse", planes(light()[::-1])), ("beauty", planes(light()))],
        [("beauty", planes(light(), "beauty")), ("normal", {f"N.{one}": light()[:, :, 0].copy() for one in "XYZ"})],
    ],
)
def test_the_part_with_the_picture_is_taken(tmp_path: Path, parts: list[tuple[str, dict[str, np.ndarray]]]) -> None:
    OpenEXR.File([OpenEXR.Part({}, channels, name) for name, channels in parts]).write(str(tmp_path / "room.exr"))
    got = import_environment(tmp_path / "room.exr")
    assert np.array_equal(got.radiance, light())
    assert any("left out: 'diffuse'" in one for one in got.warnings) == (parts[0][0] == "diffuse")


@pytest.mark.parametrize(
    "channels",
    [
        {**planes(light(), "ViewLayer.Combined"), **planes(light()[::-1], "ViewLayer.DiffCol")},
        planes(light(), "Interior"),
        {name.lower(): plane for name, plane in planes(light()).items()},
        {**planes(light()), **planes(light()[::-1], "right"), "id": np.zeros((8, 16), np.uint32)},
    ],
    ids=["blender", "one layer", "small letters", "views"],
)
def test_exr_layers(tmp_path: Path, channels: dict[str, np.ndarray]) -> None:
    assert np.array_equal(import_environment(write_exr(tmp_path / "room.exr", channels)).radiance, light())


def test_luminance_and_chroma(tmp_path: Path) -> None:
    rows, columns = np.mgrid[0:8, 0:16] / 16.0
    image = np.stack([0.2 + columns, 1.0 - 0.5 * columns, 0.3 + rows], axis=2).astype(np.float32)
    y = image @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    channels = {"Y": y, "RY": image[:, :, 0] / y - 1.0, "BY": image[:, :, 2] / y - 1.0}
    got = import_environment(write_exr(tmp_path / "room.exr", channels)).radiance
    np.testing.assert_allclose(got[:7, :15], image[:7, :15], atol=1e-5)


def test_a_map_is_the_same_in_both_formats(tmp_path: Path) -> None:
    pixels = rgbe(16, 32)
    one = import_environment(write_hdr(tmp_path / "sky.hdr", pixels, run_lengths))
    other = import_environment(write_exr(tmp_path / "sky.exr", planes(values(pixels))))
    assert np.array_equal(one.radiance, other.radiance) and one.photographed and other.photographed


def energy(radiance: np.ndarray) -> np.ndarray:
    """Return the irradiance (3,) that a map sends to its centre from all sides."""
    height, width = radiance.shape[:2]
    edges = np.cos(np.arange(height + 1) * np.pi / height)
    angle = (edges[:-1] - edges[1:]) * 2 * np.pi / width
    found: np.ndarray = np.einsum("h,hwc->c", angle, radiance.astype(np.float64))
    return found


@pytest.mark.medium
@pytest.mark.parametrize(("height", "width"), [(1024, 2048), (700, 1400)])
def test_large_maps_keep_their_energy(tmp_path: Path, height: int, width: int) -> None:
    image = np.full((height, width, 3), 0.5, np.float32)
    image[height // 20, width // 7] = [9000.0, 8000.0, 7000.0]  # a sun of one texel, near the pole
    image[:, : width // 5] *= np.array([1.0, 2.0, 3.0], np.float32)
    got = import_environment(write_exr(tmp_path / "sun.exr", {"RGB": image}))
    assert got.radiance.shape == (512, 1024, 3) and got.warnings == ()
    assert energy(got.radiance) == pytest.approx(energy(image), rel=1e-5)
    assert got.radiance[-1, -1] == pytest.approx([0.5] * 3, rel=1e-5)


@pytest.mark.parametrize("value", [-1.0, np.nan])
def test_values_that_are_not_light(tmp_path: Path, value: float) -> None:
    image = light() / 4
    image[3, 4, 1] = value
    image[6, 2] = value
    path = write_exr(tmp_path / "bad.exr", {"RGB": image})
    with pytest.raises(InputError, match=r"bad\.exr.*2 of 128 texels"):
        import_environment(path)


LINE = HEADER + b"-Y 8 +X 16\n"
BAD: dict[str, tuple[str, bytes]] = {
    "empty": ("bad.hdr", b""),
    "png as hdr": ("bad.hdr", b"\x89PNG\r\n\x1a\n\0"),
    "hdr as exr": ("bad.exr", HEADER),
    "noise as hdr": ("bad.hdr", np.random.default_rng(0).bytes(2000)),
    "cut exr": ("bad.exr", exr()[:-100]),
    "no blue": ("bad.exr", exr(names="RG")),
    "cut hdr header": ("bad.hdr", b"#?RADIANCE\nFORMAT=32-"),
    "xyz": ("bad.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 8 +X 16\n"),
    "escapes": ("bad.hdr", b"#?RADIANCE\nFORMAT=\x1b[31m\n\n-Y 8 +X 16\n"),
    "rotated": ("bad.hdr", HEADER + b"+X 16 +X 8\n"),
    "huge": ("bad.hdr", HEADER + b"-Y 99999 +X 99999\n"),
    "cut runs": ("bad.hdr", LINE + run_lengths(rgbe(8, 16))[:-1]),
    "cut pixels": ("bad.hdr", LINE + rgbe(8, 16).tobytes()[:-9]),
    "run too long": ("bad.hdr", LINE + b"\2\2\0\x10" + b"\xff\x10" * 60),
    "repeat of nothing": ("bad.hdr", LINE + b"\1\1\1\4" * 200),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files(tmp_path: Path, case: str, capfd: pytest.CaptureFixture[str]) -> None:
    name, content = BAD[case]
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(FileFormatError) as caught:
        import_environment(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@real_data
@pytest.mark.parametrize("name", ["comfy_cafe_1k", "artist_workshop_1k", "abandoned_factory_canteen_01_1k"])
def test_real_environments(name: str) -> None:
    got = import_environment(DATA / f"{name}.hdr")
    assert got.name == name and got.warnings == ()
    assert got.radiance.shape == (512, 1024, 3)
    assert got.radiance.max() > 20.0 and 0.05 < np.median(got.radiance) < 2.0


@real_data
def test_radiance_agrees_with_mitsuba() -> None:
    mitsuba = pytest.importorskip("mitsuba")
    path = DATA / "artist_workshop_1k.hdr"
    reference = np.array(mitsuba.Bitmap(str(path)))
    assert np.array_equal(import_environment(path).radiance, reference[:, :, :3])
