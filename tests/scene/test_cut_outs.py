"""Cut-outs of glTF materials: they are neither seen, nor in the mask, nor in what guides the denoiser."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

import advsearch
from advsearch.controls import make_control, make_space
from advsearch.scene.assembly import pose_mesh
from advsearch.scene.description import OBJECT
from advsearch.scene.glb import encode_glb
from advsearch.scene.importing.objects import import_object

pytestmark = pytest.mark.usefixtures("two_threads")

SIZE = 16
SEEN = {"camera.azimuth": 180.0, "camera.elevation": 0.0, "ground.size": 0.0}


def card(alpha: np.ndarray, mode: str = "MASK", shift: float = 0.0, factor: float = 1.0) -> trimesh.Trimesh:
    """An upright unit square, red, y up; the picture of its alpha (h, w) has row 0 on top."""
    vertices = np.array([[-0.5, 0, 0], [0.5, 0, 0], [0.5, 1, 0], [-0.5, 1, 0]]) + np.array([shift, 0, 0])
    texels = np.zeros((*alpha.shape, 4), np.uint8)
    texels[..., 0], texels[..., 3] = 255, np.uint8(alpha * 255)
    material = PBRMaterial(
        baseColorTexture=Image.fromarray(texels), alphaMode=mode, baseColorFactor=[1.0, 1.0, 1.0, factor],
        roughnessFactor=1.0, metallicFactor=0.0,
    )  # fmt: skip
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    return trimesh.Trimesh(
        vertices, [[0, 1, 2], [0, 2, 3]], process=False, visual=TextureVisuals(uv=uv, material=material)
    )


def window() -> np.ndarray:
    """An alpha without the middle."""
    alpha = np.ones((32, 32))
    alpha[8:24, 8:24] = 0.0
    return alpha


@pytest.fixture
def framed(tmp_path: Path) -> Path:
    file = tmp_path / "frame.glb"
    file.write_bytes(card(window()).export(file_type="glb"))
    return file


def test_what_is_cut_out_is_not_seen(framed: Path) -> None:
    scene = advsearch.load_scene(framed, settings=SEEN)
    renderer = scene.renderer("pose", resolution=SIZE, denoise="none")
    assert scene.description.notes == ()
    mask, picture = renderer.compute_object_mask(renderer.start), renderer(renderer.start, seed=0, spp=64)
    rows = np.flatnonzero(mask.any(1).numpy())
    first, last = int(rows[0]), int(rows[-1]) + 1
    hole = slice(first + (last - first) // 4 + 1, last - (last - first) // 4 - 1)
    assert last - first >= 8 and bool(mask[first : first + 2, first:last].all()) and not mask[hole, hole].any()
    red = picture[..., 0] > 2.0 * picture[..., 1]
    assert red[mask].float().mean() > 0.9 and not red[hole, hole].any()
    albedo, normal = renderer.scene.render_guides({}, 0, 64)
    assert albedo[hole, hole].max() == 0.0 and normal[hole, hole].abs().max() == 0.0
    assert albedo[mask][:, 0].mean() > 0.8 and normal[mask].norm(dim=-1).mean() > 0.8


def test_no_adjoint_that_does_not_know_the_edges_is_valid(framed: Path) -> None:
    scene = advsearch.load_scene(framed, settings=SEEN).description
    space = make_space([make_control("pose"), make_control("texture"), make_control("geometry")], scene)
    assert all(group.valid and "material" not in group.valid for group in space.groups)
    assert any("adjoint" in group.valid for group in space.groups)


@pytest.mark.parametrize(
    ("mode", "factor", "wanted"),
    [("MASK", 1.0, {0.0, 1.0}), ("MASK", 0.25, None), ("BLEND", 0.6, {0.0, 0.6}), ("OPAQUE", 0.6, None)],
)
def test_opacity_is_alpha_as_the_mode_says(mode: str, factor: float, wanted: set[float] | None, tmp_path: Path) -> None:
    file = tmp_path / "card.glb"
    file.write_bytes(card(window(), mode, factor=factor).export(file_type="glb"))
    asset = import_object(file)
    if wanted is None:
        assert asset.opacity is None
        assert ("it is fully transparent" in " ".join(asset.warnings)) == (mode == "MASK")
    else:
        assert asset.opacity is not None and {round(float(one), 2) for one in np.unique(asset.opacity)} == wanted
        assert asset.opacity.shape == (32, 32) and asset.opacity.mean() == pytest.approx(0.75 * max(wanted), abs=0.01)


def test_cut_outs_of_one_part_of_two_are_baked(tmp_path: Path) -> None:
    file = tmp_path / "two.glb"
    two = trimesh.Scene([card(window()), card(np.ones((4, 4)), "OPAQUE", shift=2.0)])
    file.write_bytes(two.export(file_type="glb"))
    asset = import_object(file)
    assert asset.opacity is not None and asset.opacity.shape == asset.base_color.shape[:2]
    mesh = asset.mesh
    for left, share in ((True, 0.75), (False, 1.0)):
        corners = mesh.uvs[(mesh.vertices[:, 1] < 0.0) == left]
        rows = slice(int((1.0 - corners[:, 1].max()) * 512), int((1.0 - corners[:, 1].min()) * 512))
        columns = slice(int(corners[:, 0].min() * 512), int(corners[:, 0].max() * 512))
        assert asset.opacity[rows, columns].mean() == pytest.approx(share, abs=0.04)


@pytest.mark.parametrize("mode", ["MASK", "BLEND"])
def test_gltf_out_has_the_same_cut_outs(mode: str, tmp_path: Path) -> None:
    file = tmp_path / "card.glb"
    file.write_bytes(card(window() if mode == "MASK" else window() * 0.6, mode).export(file_type="glb"))
    part = advsearch.load_scene(file).description.meshes[OBJECT]
    (tmp_path / "out.glb").write_bytes(encode_glb([pose_mesh(part, {})]))
    again = import_object(tmp_path / "out.glb")
    assert part.opacity is not None and again.opacity is not None
    np.testing.assert_allclose(again.opacity, part.opacity, atol=0.003)
