"""Sheets for printing, read back: sizes in millimetres, pictures put together again."""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pypdf
import pytest
from PIL import ImageCms

import advsearch
from advsearch.api.export import make_printable_pieces
from advsearch.cli.main import main
from advsearch.errors import FileFormatError
from advsearch.report.sheets import MARGIN, PAPERS, Piece, arrange_pages, write_sheets
from advsearch.runs.files import read_png, to_8bit

POINT = 25.4 / 72.0
"""Millimetres."""


def noise(height: int, width: int) -> Any:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def squares(page: Any) -> list[tuple[float, float]]:
    """Width and height in millimetres of the closed rectangles of a page."""
    text = page.get_contents().get_data().decode("latin-1")
    number = r"(-?[\d.]+) (-?[\d.]+) "
    path = re.compile(rf"{number}m\s+{number}l\s+{number}l\s+{number}l\s+{number}l")
    found = []
    for match in path.finditer(text):
        points = np.array(match.groups(), dtype=float).reshape(5, 2)
        if np.allclose(points[0], points[4]):
            found.append(tuple(np.ptp(points, axis=0) * POINT))
    return found


def images(page: Any) -> list[tuple[Any, float, float]]:
    """The pictures of a page with their width and height in millimetres, in the order in which they are drawn."""
    text = page.get_contents().get_data().decode("latin-1")
    by_name = {image.name.rpartition(".")[0]: np.asarray(image.image.convert("RGB")) for image in page.images}
    placed = re.findall(r"((?:-?[\d.]+\s+){6})cm\s+/(\w+) Do", text)
    found = []
    for numbers, name in placed:
        a, _, _, d, _, _ = map(float, numbers.split())
        levels = by_name[name]
        found.append((levels[::-1] if d < 0 else levels, abs(a) * POINT, abs(d) * POINT))
    return found


def test_a_square_of_50_millimetres_and_the_size_of_the_paper(tmp_path: Path) -> None:
    pages = write_sheets(tmp_path / "a.pdf", [Piece("p", noise(10, 20), (1.0, 2.0))], "title", paper="letter")
    read = pypdf.PdfReader(tmp_path / "a.pdf").pages
    assert len(read) == pages == 2
    assert [float(side) * POINT for side in read[0].mediabox[2:]] == pytest.approx(PAPERS["letter"], abs=1e-3)
    assert any(side == pytest.approx((50.0, 50.0), abs=1e-3) for side in squares(read[0]))
    assert "title" in read[0].extract_text()


@pytest.mark.medium
def test_what_is_larger_than_a_page_is_put_together_again(tmp_path: Path) -> None:
    picture = noise(330, 410)
    piece = Piece("wall", picture, (1.0, 1.0), (3, 3))
    pages = write_sheets(tmp_path / "a.pdf", [piece], "title")
    tiles = [part for page in arrange_pages([piece], PAPERS["a4"]) for part in page]
    drawn = [image for page in pypdf.PdfReader(tmp_path / "a.pdf").pages[1:] for image in images(page)]
    assert len(drawn) == len(tiles) > 2
    assert pages > 2
    whole = np.zeros_like(picture)
    for part, (levels, width, height) in zip(tiles, drawn, strict=True):
        x0, x1, y0, y1 = part.pixel_bounds
        assert (width, height) == pytest.approx((x1 - x0 + 6.0, y1 - y0 + 6.0), abs=1e-3)
        whole[y0:y1, x0:x1] = levels[3:-3, 3:-3]
        assert part.x >= MARGIN + 3.0
        assert part.x + x1 - x0 <= 210.0 - MARGIN
    np.testing.assert_array_equal(whole[3:-3, 3:-3], picture[3:-3, 3:-3])


def test_colours_are_converted_for_a_printer(tmp_path: Path) -> None:
    profile = tmp_path / "printer.icc"
    profile.write_bytes(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    picture = noise(8, 8)
    write_sheets(tmp_path / "a.pdf", [Piece("p", picture, (1.0, 1.0))], "t", profile=profile)
    ((levels, _, _),) = images(pypdf.PdfReader(tmp_path / "a.pdf").pages[1])
    assert np.abs(levels.astype(int) - picture).max() <= 1  # the same profile
    (tmp_path / "lab.icc").write_bytes(ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes())
    for name in ("lab.icc", "a.pdf"):
        with pytest.raises(FileFormatError, match="ICC"):
            write_sheets(tmp_path / "b.pdf", [Piece("p", picture, (1.0, 1.0))], "t", profile=tmp_path / name)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A run over the texture of the bundled mug, and one over a patch on it."""
    folder = tmp_path_factory.mktemp("runs")
    small: dict[str, Any] = {"resolution": 16, "spp": 1, "steps": 1, "trials": 6, "baseline": False}
    advsearch.attack("mug", controls={"texture": {"resolution": 64}}, run=str(folder / "texture"), **small)
    advsearch.attack("mug", controls={"patch": {"resolution": 8, "size": 0.4}}, run=str(folder / "patch"), **small)
    return {name: folder / name for name in ("texture", "patch")}


@pytest.mark.island("advsearch.controls.patch", "advsearch.cli.exporters.sheets")
@pytest.mark.medium
def test_a_texture_is_printed_in_pieces_of_their_real_size(runs: dict[str, Path]) -> None:
    pieces = make_printable_pieces(runs["texture"], 95.0)
    wall = pieces[0]
    vertices = advsearch.load_scene("mug").description.object.mesh.vertices
    rim = 95.0 * float(np.ptp(vertices[:, 0]))  # the handle points along y
    assert 0.92 * rim < wall.size[0] / math.pi < rim  # the mug narrows downwards
    twice = make_printable_pieces(runs["texture"], 190.0)[0]
    assert twice.size == pytest.approx([2 * side for side in wall.size], rel=1e-6)
    texture = to_8bit(read_png(runs["texture"] / "artifacts" / "texture.png"))
    known = {tuple(colour) for colour in texture.reshape(-1, 3)}
    for piece in pieces:
        (left, top), parts = piece.bleed, 9
        inner = piece.picture[top:-top, left:-left] if left else piece.picture
        middles = inner[parts // 2 :: parts, parts // 2 :: parts]
        assert {tuple(colour) for colour in middles.reshape(-1, 3)} <= known, piece.name


@pytest.mark.island("advsearch.controls.patch", "advsearch.cli.exporters.sheets")
def test_the_command_writes_a_pdf_and_says_what_it_needs(
    runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "sheet.pdf"
    run = str(runs["patch"])
    assert main(["export", run, "--format", "print", "--out", str(out), "--json", "--size", "95"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["pages"] == len(pypdf.PdfReader(out).pages) == 3 and told["size_mm"] == 95.0
    for wrong, message in (
        (["--format", "print", "--size", "95"], "--out"),
        (["--format", "print", "--out", str(out), "--size", "0"], "size: expected the object's longest side"),
        (["--format", "csv", "--size", "95"], "--size: belongs to --format print"),
        (["--format", "csv", "--sheets", "9"], "--sheets: belongs to --format print"),
        (["--format", "print", "--out", str(out), "--size", "9900"], "or use a larger --paper or a smaller --size"),
    ):
        assert main(["export", run, *wrong]) == 2
        assert message in capsys.readouterr().err
