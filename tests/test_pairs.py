"""What a row stores of a configuration is true of it alone, whatever was rendered before: over all pairs of controls.

Each control is here in a small form whose values leave the start. A row is checked against a space and a renderer that
were made for it alone, and against a scene in which the values that the row names are fixed.
"""

import itertools
from collections.abc import Iterable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.attacks import Query
from advsearch.controls import CONTROLS, compose_space, make_control, make_space
from advsearch.engine.judging import make_domain
from advsearch.engine.loading import fit_camera, make_renderer
from advsearch.engine.problem import Problem
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.sweep.axes import SceneConfigurations, add_grid_axes, parse_axes
from advsearch.runs.results import to_json_value
from advsearch.scene.color import round_to_8_bit
from advsearch.scene.description import load_description
from advsearch.tasks import Classification

SIZE = 16
ROWS = 2
"""Of each sweep."""
CLOSE = 0.01
"""Mean difference of two pictures with the same noise up to which they show the same: a value that a row names is
rounded, so that single light paths may go another way."""

GRID = {"camera.sizes": [1.6, 2.6]}
"""What varies beside a pair, unless it is the camera."""

FORMS: dict[str, dict[str, Any]] = {
    "pose": {"yaw": [0, 300], "x": [-0.2, 0.2], "scale": [0.7, 1.1]},
    "camera": {"azimuth": [0, 300], "elevation": [10, 50], "roll": [-10, 10], "exposure": [-1, 1]},
    "path": {"time": [7, 10]},
    "texture": {"resolution": 4, "epsilon": 0.4},
    "material": {"which": ["wood", "steel"], "red": [0.3, 1.0]},
    "light": {"power": [2, 8], "x": [-2, 2], "red": [0.5, 1.0]},
    "projector": {"resolution": 4, "lumens": [1, 40], "elevation": [10, 60]},
    "shadow": {"size": [0.1, 0.8], "x": [-0.5, 0.5]},
    "environment": {"which": ["own", "noon", "kitchen"], "rotation": [0, 300], "exposure": [-1, 1]},
    "sky": {"azimuth": [0, 300], "elevation": [10, 80]},
    "geometry": {"modes": 4, "epsilon": 0.1},
    "patch": {"resolution": 4, "azimuth": [0, 360], "size": [0.2, 0.6]},
    "things": {"x": [-0.05, 0.1], "y": [-0.2, 0.05], "heading": [-90, 90], "presence": ["there", "away"]},
    "occlusion": {"which": ["card", "sphere"], "coverage": [0.1, 0.5], "direction": [0, 300]},
    "contents": {"level": [0.3, 0.9], "milk": [0.2, 0.8]},
    "background": {"ground": "keep", "hue": [0, 300], "saturation": [0.5, 1.0]},
    "haze": {"density": [0.1, 0.5], "blue": [0.3, 1.0]},
    "lens": {"dots": 2, "opacity": [0.2, 0.9], "x": [0.1, 0.9]},
    "sensor": {"shot": [0.0, 0.2], "mosaic": [0, 1], "compression": [0, 80]},
    "corruption": {"which": ["fog", "jpeg", "gaussian_noise"], "severity": [0, 5]},
    "mitsuba": {"ground.bsdf.brdf_0.reflectance.value": [0.1, 0.9]},
}
APART = {"backdrop"}
"""Needs a folder of photographs, which most others refuse; tests/controls and tests/engine/test_sweep.py try it."""
# another one varies as it declares itself
FORMS |= {kind: {} for kind in CONTROLS.built_ins if kind not in FORMS and kind not in APART}
EXCLUSIVE = {frozenset(("sky", "environment")), frozenset(("path", "camera")), frozenset(("geometry", "body"))}
EXCLUSIVE |= {frozenset(("contents", "body")), frozenset(("material", "body"))}
"""Pairs that set the same input and are refused; nobody is a vessel, and no named material covers a person."""

ALL = [(one,) for one in FORMS] + [
    pair for pair in itertools.combinations(FORMS, 2) if frozenset(pair) not in EXCLUSIVE
]
PICTURES = ("patch", "projector")
"""Controls with a picture, of which a row has no values."""
QUICK = ["camera-occlusion", "pose-contents", "material-patch"]
"""Pairs in which one control goes by what the other does, or both meet in one input; the others take minutes."""


def suited(kinds: Iterable[str]) -> str:
    """An object that some controls can change."""
    return "person" if "body" in kinds else "mug"


def beside(kinds: Iterable[str]) -> str | None:
    """What `things` moves."""
    return "bottle@0.2,0.1" if "things" in kinds else None


def pairs(quick: list[str]) -> list[Any]:
    """All pairs as parameters of a test, those marked as slow that are not quick."""
    names = ["-".join(pair) for pair in ALL]
    marks = [() if name in quick else pytest.mark.slow for name in names]
    return [pytest.param(pair, id=name, marks=mark) for pair, name, mark in zip(ALL, names, marks, strict=True)]


class Weighted(nn.Module):
    """Four classes by fixed random weights of the pixels."""

    def __init__(self) -> None:
        super().__init__()
        weights = torch.randn(4, SIZE * SIZE * 3, generator=torch.Generator().manual_seed(5))
        self.register_buffer("weights", weights - weights.mean(dim=1, keepdim=True))

    def forward(self, images: Tensor) -> Tensor:
        return (images.flatten(1) - 0.5) @ self.weights.T  # type: ignore[operator]


@pytest.fixture(scope="module")
def model() -> advsearch.Model:
    return advsearch.load_model(Weighted(), labels=("mug", "vase", "bowl", "pan"), input_size=SIZE, name="weighted")


@pytest.mark.medium
def test_every_control_is_here_and_varies() -> None:
    assert set(FORMS) | APART == set(CONTROLS.built_ins), "FORMS names a control that there is not"
    for kind, form in FORMS.items():
        varied = compose_space(
            [make_control(kind, form)], load_description(suited([kind]), things=beside([kind]))
        ).start.numel()
        assert varied, f"{kind} has no range: give a parameter `search=(low, high)`, or {kind} a form in FORMS"


@pytest.mark.medium
@pytest.mark.parametrize("pair", pairs(QUICK))
def test_a_row_of_a_sweep_is_true_of_its_own_picture(pair: tuple[str, ...], model: advsearch.Model) -> None:
    scene = advsearch.load_scene(suited(pair), things=beside(pair))
    controls = {kind: FORMS[kind] for kind in pair}
    grid = {} if {"camera", "path"} & set(pair) else GRID
    samples = ROWS // (2 if grid else 1)
    found = advsearch.sweep(
        scene,
        model,
        grid,
        controls=controls,
        samples=samples,
        trials=0,
        spp=1,
        denoise="none",
        seed=3,
        resolution=SIZE,
        label="mug",  # of a person too: the model knows none
    )
    description = fit_camera(scene.description, SIZE)
    drawn = tuple(make_control(kind, given) for kind, given in controls.items())
    axes = parse_axes(grid, drawn)
    rows = {row.step: row for row in found.rows()}
    worst = found.summary.worst
    assert worst is not None and to_json_value(worst.values) == rows[worst.configuration].values
    for row in rows.values():
        assert row.seed is not None
        space = make_space(add_grid_axes(drawn, axes, description), description)
        points = SceneConfigurations(space, make_domain(space.controls), axes, samples, "sobol", 3)
        u = points.make_configurations(row.step, 1)[0]
        said = {name: value for name, value in row.values.items() if "." in name}
        assert_close(said, points.describe_images(u[None], row.step)[0], 1e-6)  # threads add up a mean in another order
        assert_close(said, space.describe(u))
        renderer = make_renderer(description, space, SIZE, "none", 3)
        picture = round_to_8_bit(renderer(u, seed=row.seed, spp=1)[None])
        ((seen,),) = Classification().predictions(model(picture))
        assert row.label_index == seen.index and row.probability == pytest.approx(seen.probability, rel=1e-4)
        assert_true_of_fixed_values(scene, drawn, said, picture[0], row.seed)


def assert_close(said: dict[str, Any], other: dict[str, Any], close: float = 1e-4) -> None:
    """Check that two descriptions agree up to single precision."""
    assert said.keys() == other.keys()
    for name, value in said.items():
        one, two = value["value"], other[name]["value"]
        assert one == (two if isinstance(one, str) else pytest.approx(two, rel=close, abs=close)), name


def assert_true_of_fixed_values(
    scene: advsearch.Scene, drawn: Any, said: dict[str, Any], picture: Tensor, seed: int
) -> None:
    """Check that a scene with the values that a row names looks as the row's picture, and says the same of itself."""
    if not all(control.parameters and control.kind not in ("texture", "geometry") for control in drawn):
        return
    named: dict[str, dict[str, Any]] = {
        control.kind: {one.name: control.choice_values[one.name] for one in control.choices if not one.bounds}
        for control in drawn
    }
    for name, value in said.items():
        kind, _, parameter = name.partition(".")
        declared = {one.name for one in CONTROLS[kind].declare_parameters([parameter])}
        if parameter in declared:
            named.setdefault(kind, {})[parameter] = value["value"]
        elif kind in PICTURES or ("." in parameter and parameter.partition(".")[0] in declared):
            return  # one number of many cannot be fixed alone, and neither can a picture
    description = fit_camera(scene.description, SIZE)
    space = compose_space([make_control(kind, given) for kind, given in named.items()], description)
    renderer = make_renderer(description, space, SIZE, "none", 3)
    again = round_to_8_bit(renderer(space.start, seed=seed, spp=1))
    if "sky" not in named:  # the exposure is metered at the start, which a fixed sky moves
        assert float((again - picture).abs().mean()) < CLOSE
    described = space.describe(space.start)
    for name, value in said.items():
        if name in described and not isinstance(value["value"], str):
            assert described[name]["value"] == pytest.approx(value["value"], rel=1e-3, abs=1e-3), name


def searched_picture(problem: Problem, u: Tensor) -> Tensor:
    """The picture (H, W, 3) that a search's evaluation of a configuration looks at."""
    picture = problem.evaluate(Query(u, 5, phase="search", includes_image=True)).picture
    assert picture is not None
    return picture


def assert_close_pictures(one: Tensor, other: Tensor) -> None:
    """Check that two pictures with the same noise are one, but for a single path: what moved before is sorted into
    another tree, and a last bit can send a path of one sample another way (docs/design.md, "Determinism")."""
    assert int(((one - other).abs().amax(dim=-1) > 0.5 / 255).sum()) <= 1


@pytest.mark.medium
@pytest.mark.parametrize("pair", pairs(QUICK[:1]))
def test_a_row_of_an_attack_is_true_of_its_own_picture(pair: tuple[str, ...]) -> None:
    config = AttackConfig(
        object=suited(pair), things=beside(pair), label=["mug"], controls={kind: FORMS[kind] for kind in pair},
        resolution=SIZE, spp=1, denoise="none", measure="no",
    )  # fmt: skip
    problem, _ = problem_from_config(config)
    draws = [problem.domain.sample(torch.Generator().manual_seed(seed))[0] for seed in (1, 2)]
    rows = [(problem.evaluate(Query(u, 7)).required_judgement, problem.describe(u)) for u in draws]
    seen = [searched_picture(problem, u) for u in draws]
    for u, (trial, values), picture in zip(draws, rows, seen, strict=True):
        alone, _ = problem_from_config(config)
        assert_close(values, alone.describe(u))
        again = alone.evaluate(Query(u, 7)).required_judgement
        assert trial.prediction.index == again.prediction.index
        assert (trial.margin, trial.prediction.probability) == pytest.approx(
            (again.margin, again.prediction.probability), rel=1e-3, abs=1e-3
        )
        assert_close_pictures(picture, searched_picture(alone, u))


@pytest.mark.medium
def test_an_occluder_is_described_under_the_conditions_of_its_own_draw() -> None:
    config = AttackConfig(
        object="mug", controls={"occlusion": {"coverage": [0.2, 0.4]}}, over={"camera": {"sizes": [1, 5]}},
        resolution=SIZE, measure="no",
    )  # fmt: skip
    problem, _ = problem_from_config(config)
    u = torch.tensor([0.5])
    seen = set()
    for seed in (3, 4):
        said = {**problem.describe(u, seed), **problem.describe_conditions(u, seed)}
        camera = make_control("camera", {"sizes": said["camera.sizes"]["value"]})
        alone = load_description("mug")
        occlusion = make_control("occlusion", {"coverage": [0.2, 0.4]})
        space = make_space([occlusion, camera], alone)
        fresh = space.describe(torch.cat([u, space.start[1:]]))
        assert said["occlusion.true_distance"]["value"] == pytest.approx(fresh["occlusion.true_distance"]["value"])
        seen.add(said["occlusion.true_distance"]["value"])
    assert len(seen) == 2


def test_the_picture_of_a_material_that_is_kept_has_the_texture_that_lies_under_it() -> None:
    controls = [make_control("texture", {"resolution": 8, "epsilon": 0.4}), make_control("material", {"red": [0.3, 1]})]
    space = make_space(controls, load_description("mug"))
    painted = space.start.clone()
    painted[:-1] = (painted[:-1] + 0.4).clamp(0.0, 1.0)
    kept = space.get_artifact_images(painted)
    assert torch.allclose(kept["material"], kept["texture"], atol=1e-4)
    assert not torch.allclose(kept["material"], space.get_artifact_images(space.start)["material"], atol=0.05)
