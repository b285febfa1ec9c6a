"""Controls make what they give on the device of the search's numbers."""

from typing import Any

import pytest
import torch

import advsearch
from advsearch.controls import CONTROLS, compose_space, make_control
from conftest import ROOT
from elsewhere import ELSEWHERE, Away, elsewhere
from samples import load_photographed_box

PICTURE = str(ROOT / "advsearch/bundled/data/objects/book/base_color.png")

FORMS: dict[str, tuple[dict[str, Any], ...]] = {
    "camera": (
        {"exposure": [-1, 1]}, {"aperture": [0.0, 0.1], "fov": [20, 60]}, {"focal_length": [20, 60], "shift_x": [0, 1]},
    ),
    "pose": ({}, {"rotation": [-90, 90], "on_ground": "no"}),
    "texture": tuple({"form": form, "resolution": 16} for form in ("texels", "palette", "waves")),
    "material": ({}, {"which": ["wood", "steel"], "red": [0.3, 1.0]}),
    "light": ({}, {"type": "point"}),
    "environment": ({}, {"which": ["own", "noon"], "harmonics": [-0.1, 0.1]}),
    "sky": ({}, {"exposure": "fixed", "azimuth": [0, 90]}),
    "geometry": ({"modes": 4}, {"form": "large-steps"}),
    "patch": ({"resolution": 4, "azimuth": [0, 360]}, {"picture": PICTURE, "size": [0.2, 0.6]}),
    "occlusion": ({}, {"which": ["card", "sphere"], "turn": [0, 90]}),
    "lens": ({}, {"dots": 2, "opacity": [0.2, 0.9]}),
    "sensor": ({"shot": [0.0, 0.2], "mosaic": [0, 1], "compression": [0, 80], "aberration": [0.0, 0.02]},),
    "mitsuba": ({"ground.bsdf.brdf_0.reflectance.value": [0.1, 0.9]},),
}  # fmt: skip
"""Settings under which a control takes all its ways; it is tried with none where it is not here."""

if "corruption" in CONTROLS:
    from advsearch.controls.corruption import CORRUPTION_NAMES

    FORMS["corruption"] = tuple(
        {"which": which, "severity": severity} for which in CORRUPTION_NAMES for severity in ([0.2, 0.9], [3.2, 4.9])
    )

CASES = [
    pytest.param(kind, given, id=f"{kind}-{number}")
    for kind in CONTROLS
    if CONTROLS[kind].__module__.startswith("advsearch.")
    for number, given in enumerate(FORMS.get(kind, ({},)))
]


@pytest.mark.medium
@pytest.mark.parametrize(("kind", "given"), CASES)
def test_what_a_control_gives_lies_where_the_searchs_numbers_do(kind: str, given: dict[str, Any]) -> None:
    beside = "bottle@0.4,0.1" if kind == "things" else None
    scene = advsearch.load_scene("person" if kind == "body" else "mug", things=beside).description
    if kind == "backdrop":
        scene = load_photographed_box().description
    space = compose_space((make_control(kind, given),), scene)
    u = (0.25 * space.start + 0.5).clamp(0.0, 1.0)
    image = torch.full((8, 8, 3), 0.5)
    expected, seen = space.inputs(u), space.apply_to_image(u, image)
    with elsewhere():
        moved, away = u.to(ELSEWHERE), image.to(ELSEWHERE)
        found, picture = space.inputs(moved), space.apply_to_image(moved, away)
        said = space.describe(moved)
    assert {name for name, one in found.items() if not isinstance(one, Away)} == set()
    for name, one in found.items():
        assert isinstance(one, Away) and torch.equal(one.held, expected[name]), name
    assert isinstance(picture, Away) and torch.equal(picture.held, seen)
    assert said == space.describe(u)
