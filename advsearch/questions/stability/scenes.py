"""Cases of scenes that break naive code: light, surfaces, meshes, poses and views."""

from __future__ import annotations

import math
import statistics
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import OpenEXR
import torch
from torch import Tensor

from advsearch.extend import (
    InputError,
    RunContext,
    assets,
    errors,
    geometry,
    gradients,
    policies,
    workbench,
)
from advsearch.questions.stability.result import (
    ALL_CASES,
    Case,
    CaseOutcome,
    CaseRow,
    Check,
    StabilityConfig,
    StabilityResult,
    check_condition,
    check_range,
    register_case,
    register_cases,
)
from advsearch.questions.stability.scene import (
    LOGIT_SCALE,
    MAX_GRADIENT_ERROR,
    MAX_PICTURE_DIFFERENCE,
    REFERENCE_SPP,
    SPP,
    ControlSettings,
    check_scene,
    compare_gradient,
    compute_mean_difference,
    describe_mug,
    evaluate,
    make_checkered_mug,
    make_checkered_object,
    make_dark_mug,
    make_domain,
    make_gray_environment,
    make_mesh,
    make_renderer,
    measure_inward_slope,
    render_image,
    run_search,
)

BRIGHT = 1e5
NOT_ZERO = (1e-12, None)
"""Bounds of the largest entry of a gradient, if it must not be zero."""
# number of evaluations in which a search has to leave a plateau
PLATEAU_STEPS = 40
TEXTURE: ControlSettings = {"texture": {"resolution": 8}}
FLASH = make_gray_environment(0.3, BRIGHT)
DARKNESS = make_gray_environment(0.0)


def make_exposure_arguments(control: str, low: float, high: float) -> dict[str, object]:
    """Return arguments of `check_scene` for the extreme end of a range of exposures.

    That is the upper end of a range of positive exposures (in stops), and the lower end
    of a range of negative ones. The exposure is the first value of the configuration.
    """
    is_upper_end = high > 0.0
    return {
        "controls": {control: {"exposure": [low, high]}, "texture": {"resolution": 8}},
        "u": {0: 1.0 if is_upper_end else 0.0},  # by the index of the value
        "slow": control == "environment",
    }


FINITE = "Picture and gradient are finite."
FINITE_AND_RIGHT = (
    "Picture and gradient are finite; the gradient of the linear picture is right."
)
LAMP = {"light": {"type": "point", "power": [0.0, 20.0], "x": 1.0, "y": 1.0, "z": 2.0}}
BRIGHT_TEXEL = {"environment": {"exposure": [-1.0, 1.0]}, "texture": {"resolution": 16}}
ROTATED_ENVIRONMENT = {"environment": {"rotation": [0.0, 360.0]}}

register_cases(
    "radiometric",
    check_scene,
    [
        (
            "hdri-texel-100000",
            "One texel of 100,000 leaves everything finite, and gradients are right.",
            {"controls": BRIGHT_TEXEL, "environment": FLASH, "slow": True},
        ),
        (
            "hdri-texel-100000-denoised",
            "It is finite after the denoiser too, and the rotation has a gradient.",
            {
                "controls": ROTATED_ENVIRONMENT,
                "environment": FLASH,
                "denoise": "oidn",
                "u": [0.31],
                "compare": False,
                "gradient": NOT_ZERO,
                "slow": True,
            },
        ),
        (
            "black-environment",
            "The picture is black, the gradient zero, and the search ends as stalled.",
            {
                "controls": TEXTURE,
                "environment": DARKNESS,
                "compare": False,
                "evaluations": PLATEAU_STEPS,
                "mean": (0.0, 0.0),
                "gradient": (0.0, 0.0),
                "ending": "stalled",
            },
        ),
        (
            "lamp-in-the-dark",
            "A lamp lights a scene that has no other light.",
            {
                "controls": LAMP,
                "environment": DARKNESS,
                "u": [0.5],
                "mean": (0.01, None),
            },
        ),
        (
            "camera-exposure-up",
            FINITE_AND_RIGHT,
            make_exposure_arguments("camera", 9.0, 10.0),
        ),
        (
            "camera-exposure-down",
            FINITE_AND_RIGHT,
            make_exposure_arguments("camera", -10.0, -9.0),
        ),
        (
            "environment-exposure-up",
            FINITE_AND_RIGHT,
            make_exposure_arguments("environment", 9.0, 10.0),
        ),
        (
            "environment-exposure-down",
            FINITE_AND_RIGHT,
            make_exposure_arguments("environment", -10.0, -9.0),
        ),
    ],
)


def refuse_texel(value: float, as_file: bool) -> CaseOutcome:
    """Require that an environment map is rejected for a texel that is no light.

    The error message has to be a sentence that states the number of such texels.

    Args:
        value: value of the texel.
        as_file: whether the map is in a file, or else in an array.
    """
    radiance = make_gray_environment(0.3).radiance.copy()
    radiance[4, 10] = value
    try:
        _load_environment(radiance, as_file)
    except InputError as error:
        is_sentence = "texels" in str(error) and "\n" not in str(error)
        check = check_condition(
            "refused in a sentence that counts the texels", is_sentence
        )
        return CaseOutcome([check], ending="refused")
    return CaseOutcome(
        [check_condition("refused", False)], ending="rendered all the same"
    )


def _load_environment(radiance: assets.Float32Array, as_file: bool) -> None:
    """Load a scene with an environment map from a file, or render one from an array."""
    if as_file:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "bad.exr"
            with OpenEXR.File({}, {"RGB": radiance}) as picture:
                picture.write(str(path))
            workbench.load_scene("mug", path)
    else:
        renderer = make_renderer(
            TEXTURE, environment=assets.EnvironmentAsset("made", radiance)
        )
        render_image(renderer, renderer.start, seed=0, spp=1)


REFUSED = "The map is refused before anything is rendered."
for word, value in (("negative", -1.0), ("infinite", math.inf), ("nan", math.nan)):
    for source in ("file", "array"):
        arguments = {"value": value, "as_file": source == "file"}
        table = [(f"{word}-texel-{source}", REFUSED, arguments)]
        register_cases("radiometric", refuse_texel, table)


def leave_plateau(low: float, high: float) -> CaseOutcome:
    """Search for a darker picture from a white one, where the gradient is zero.

    All pixels are clipped at white, so the loss is constant near the start. Policies
    have to find a lower exposure without a gradient.

    Args:
        low, high: range of the exposure in stops. Above about 4 stops all pixels are
            white.
    """
    renderer = make_renderer({"camera": {"exposure": [low, high]}})
    # the highest exposure, as 1 is the upper bound of each range
    start = torch.ones_like(renderer.start)
    checks = []
    endings = []
    n_flat = 0
    # `adam` is a part that may be absent
    names = [name for name in ("pgd", "adam", "auto") if name in policies.POLICIES]
    for policy in map(workbench.make_policy, names):
        result = run_search(
            renderer, _darkness, PLATEAU_STEPS, spp=2, start=start, policy=policy
        )
        n_flat += sum(record.gradient_norm == 0.0 for record in result.history)
        # `_darkness` is above 0 if the image is not white.
        is_darker = result.best_objective > 0.0
        description = f"{policy.name} finds a picture that is not white"
        checks.append(check_condition(description, is_darker))
        endings.append(f"{policy.name}: {result.ending.value}")
    return CaseOutcome(
        [_check_flat_start(renderer, start), *checks],
        ending=", ".join(endings),
        measurements={"evaluations without a gradient": float(n_flat)},
    )


def _check_flat_start(renderer: gradients.Renderer, start: Tensor) -> Check:
    """Check that the gradient of the darkness is zero at a start (d,)."""
    query = workbench.Query(start, 0, gradient=True)
    gradient = evaluate(renderer, _darkness, 2, query).gradient
    assert gradient is not None
    largest = float(gradient.abs().max())
    return check_range("gradient at the start", largest, min_value=0.0, max_value=0.0)


def _darkness(image: Tensor) -> Tensor:
    """Return a loss of the image that is above 0 if its mean is below 0.9."""
    return 0.9 - image.mean()


LEAVES_PLATEAU = (
    "From a white picture without a gradient every policy gets away within "
    f"{PLATEAU_STEPS} evaluations"
)
register_cases(
    "radiometric",
    leave_plateau,
    [
        ("saturated-plateau", f"{LEAVES_PLATEAU}.", {"low": -10.0, "high": 10.0}),
        (
            "saturated-plateau-narrow-way-out",
            f"{LEAVES_PLATEAU}; the way out is a tenth of the range.",
            {"low": 1.0, "high": 10.0},
        ),
    ],
)


# ---- surfaces


def make_glass_ball() -> dict[str, dict[str, object]]:
    """Return a glass ball between camera and mug, as Mitsuba's dictionary by name."""
    camera = geometry.camera_to_world(describe_mug())[:3, 3]
    # The mug stands at the origin, so this is on the way to the camera, a bit higher.
    center = [float(value) for value in camera * 0.6 + np.array([0.0, 0.0, 0.2])]
    material = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    return {
        "glass": {"type": "sphere", "center": center, "radius": 0.3, "bsdf": material}
    }


def make_material_arguments(
    parameters: tuple[str, ...], slow: bool = True, **values: float
) -> dict[str, object]:
    """Return arguments of `check_scene` for a material.

    Args:
        parameters: parameters of the material, which vary in [0, 1].
        slow: whether the case is slow.
        **values: values of the material at the start.
    """
    settings = {f"material.{name}": value for name, value in values.items()}
    return {
        "controls": {"material": {name: [0.0, 1.0] for name in parameters}},
        "settings": settings,
        "slow": slow,
    }


register_cases(
    "materials",
    check_scene,
    [
        (
            "roughness-0",
            "Finite, and the gradient by the roughness is right, at the polished end.",
            make_material_arguments(("roughness",), slow=False, roughness=0.0),
        ),
        (
            "roughness-1",
            "Finite, and the gradient by the roughness is right, at the matt end.",
            make_material_arguments(("roughness",), roughness=1.0, metallic=1.0),
        ),
        (
            "metallic-1",
            "Finite, and the gradient has the right sign and size at a metallic "
            "of exactly 1.",
            make_material_arguments(("metallic",), metallic=1.0),
        ),
        (
            "perfect-mirror",
            "A metal of roughness 0 is finite, and both gradients are right.",
            make_material_arguments(
                ("roughness", "metallic"), roughness=0.0, metallic=1.0
            ),
        ),
    ],
)


@register_case("materials", "clear-glass", slow=True)
def look_through_glass() -> CaseOutcome:
    """A texel behind clear glass has the right gradient, and nothing is NaN."""
    controls: ControlSettings = {
        "texture": {"resolution": 8},
        "environment": {"exposure": [-1.0, 1.0]},
    }
    # `check_scene` compares the gradient with finite differences. An empty `other_scene`
    # is the scene with the same controls and no plugin, thus without the glass. The
    # image has to differ from it.
    return check_scene(
        controls, plugins=make_glass_ball(), other_scene={}, difference=(0.01, None)
    )


@register_case("materials", "texels-0-and-1")
def texels_at_the_ends() -> CaseOutcome:
    """Texels at the ends of the range have a gradient, and the search moves them
    inwards only.

    The texture is a checkerboard of 0 and 1, which are the bounds.
    """
    controls = {"texture": {"resolution": 8, "epsilon": 0.2}}
    renderer = make_renderer(controls, make_checkered_mug)
    error = _measure_inward_error(renderer)
    error_check = check_range(
        "gradient error along a direction that points inwards",
        error,
        max_value=MAX_GRADIENT_ERROR,
    )
    loss = gradients.make_smooth_loss(renderer.formation.resolution)
    best = run_search(renderer, loss, steps=3).best_u
    checks = [error_check, *_check_texels(renderer.start, best)]
    scene = check_scene(controls, make_checkered_mug, compare=False)
    return scene.with_checks(*checks, relative_error=error)


def _measure_inward_error(renderer: gradients.Renderer) -> float:
    """Return the relative error of the gradient along a direction that points inwards.

    The reference is the derivative by finite differences.
    """
    slope, expected_slope = measure_inward_slope(
        renderer,
        _compute_mean_gradient(renderer),
        factor=1.0,
        seeds=8,
        spp=REFERENCE_SPP,
    )
    return abs(slope / expected_slope - 1.0)


def _check_texels(start: Tensor, best: Tensor) -> list[Check]:
    """Check that a search moved texels (d,), and only inwards from 0 and 1.

    Args:
        start: the texels at the start.
        best: those of the adversarial configuration.
    """
    n_moved = float((best != start).sum())
    has_both_bounds = set(start.tolist()) == {0.0, 1.0}
    return [
        check_range(
            "smallest texel of the adversarial configuration",
            float(best.min()),
            min_value=0.0,
        ),
        check_range(
            "largest texel of the adversarial configuration",
            float(best.max()),
            max_value=1.0,
        ),
        check_range("texels that the search moved", n_moved, min_value=1.0),
        check_condition("the start has both 0 and 1", has_both_bounds),
    ]


def _compute_mean_gradient(renderer: gradients.Renderer) -> Tensor:
    """Return the mean gradient (d,) of a smooth loss over 8 seeds.

    The loss is of the linear image, without a tone curve.
    """
    linear = renderer.copy_with(transfer="linear")
    loss = gradients.make_smooth_loss(linear.formation.resolution)
    samples = []
    for seed in range(8):
        _, gradient = linear.gradient(loss, renderer.start, seed, REFERENCE_SPP)
        samples.append(gradient)
    return torch.stack(samples).mean(dim=0)


# ---- light that is thrown

# width and height of a projector's image in texels
SIDE = 8
WHITE_PICTURE = [1.0] * (3 * SIDE**2)
CENTER_TEXEL = {3 * (SIDE**2 // 2 + SIDE // 2) + channel: 1.0 for channel in range(3)}


def make_projector_arguments(
    u: Sequence[float] | Mapping[int, float] = WHITE_PICTURE, **projector: float
) -> dict[str, object]:
    """Return arguments of `check_scene` for a projector whose texels have a gradient.

    Args:
        u: texels of the projected image: the first ones, or values by index.
        **projector: settings of the control.
    """
    return {
        "controls": {"projector": {"resolution": SIDE, **projector}},
        "u": u,
        "compare": False,
        "gradient": NOT_ZERO,
    }


register_cases(
    "light",
    check_scene,
    [
        (
            "projector-black",
            "A black picture changes nothing, and texels have a gradient.",
            {
                **make_projector_arguments({}),
                "other_scene": {"controls": {"lens": {}}},
                "difference": (None, 0.02),
            },
        ),
        ("projector-full", FINITE, make_projector_arguments()),
        ("projector-one-texel", FINITE, make_projector_arguments(CENTER_TEXEL)),
        ("projector-grazing", FINITE, make_projector_arguments(elevation=0.5)),
        (
            "projector-behind-the-object",
            FINITE,
            make_projector_arguments(azimuth=220.0),
        ),
        (
            "projector-inside-the-object",
            FINITE,
            make_projector_arguments(distance=0.01, fov=30.0),
        ),
        (
            "projector-into-a-mirror",
            FINITE,
            {
                **make_projector_arguments(),
                "settings": {"material.metallic": 1.0, "material.roughness": 0.0},
            },
        ),
        (
            "projector-0-lumens",
            "Without light the gradient is zero.",
            {**make_projector_arguments(lumens=0.0), "gradient": (0.0, 0.0)},
        ),
        (
            "projector-1e6-lumens",
            "The picture is white for the most part, and all is finite.",
            {
                **make_projector_arguments(lumens=1e6),
                "gradient": (None, None),
                "mean": (0.7, None),
            },
        ),
        (
            "spot-smallest",
            "Picture and gradient of a laser's spot are finite.",
            {
                "controls": {"spot": {"width": [0.02, 0.1], "lumens": [0.0, 10.0]}},
                "u": [0.0, 1.0],
                "compare": False,
                "gradient": NOT_ZERO,
            },
        ),
    ],
)


@register_case("light", "projector-through-glass")
def project_through_glass() -> CaseOutcome:
    """Light that meets glass on its way leaves picture and gradient finite."""
    arguments = make_projector_arguments(
        azimuth=describe_mug().get_number("camera.azimuth")
    )
    return check_scene(**arguments, plugins=make_glass_ball())  # type: ignore[arg-type]


# ---- meshes, places and views

# a square that faces +x
QUAD = [[0.0, -0.5, 0.0], [0.0, 0.5, 0.0], [0.0, 0.5, 1.0], [0.0, -0.5, 1.0]]
HALVES = [[0, 1, 2], [0, 2, 3]]
SQUARE = make_checkered_object(make_mesh(QUAD, HALVES))
LINE = [[0.0, 0.0, 0.5], [0.0, 0.1, 0.5], [0.0, 0.2, 0.5]]
DEGENERATE = make_checkered_object(
    make_mesh(QUAD + LINE, [*HALVES, [0, 0, 1], [4, 5, 6], [4, 4, 4]])
)
COINCIDENT_SQUARES = make_checkered_object(
    make_mesh(QUAD + QUAD, [*HALVES, [4, 5, 6], [4, 6, 7]])
)
THIN = [[0.0, -0.5, 0.5], [0.0, 0.5, 0.5], [0.0, 0.5, 0.5 + 1e-6]]
SLIVER = make_checkered_object(make_mesh(QUAD + THIN, [*HALVES, [4, 5, 6]]))
TRIANGLE = make_checkered_object(
    make_mesh([[0.0, -0.5, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 1.0]], [[0, 1, 2]])
)
FRONT_VIEW = {"camera.azimuth": 0.0, "camera.elevation": 10.0}
TEXTURED_MOVE: ControlSettings = {
    "texture": {"resolution": 8},
    "pose": {"y": [-0.3, 0.3]},
}
SHIFT: ControlSettings = {"pose": {"x": [-0.3, 0.3]}}
# settings without the ground, so that a dark object has an outline and nothing else
NO_GROUND = {"ground.size": 0.0}


def make_mesh_arguments(
    thing: assets.ObjectAsset, other_object: assets.ObjectAsset | None = None
) -> dict[str, object]:
    """Return arguments of `check_scene` for a mesh that is painted and moved.

    Args:
        thing: the object.
        other_object: an object that looks the same from the front. Its image is
            compared with that of the first; None compares nothing.
    """
    other_scene: dict[str, object] = {}
    if other_object:
        other_scene["other_scene"] = {"thing": other_object, "settings": FRONT_VIEW}
    return {
        "controls": TEXTURED_MOVE,
        "thing": thing,
        "settings": FRONT_VIEW,
        "slow": True,
        **other_scene,
    }


def import_box(scale: float = 1.0, shift: float = 0.0) -> assets.ObjectAsset:
    """Import a box from an OBJ file.

    Args:
        scale: factor on the size of the box in the file.
        shift: distance of the box from the origin of the file, along each axis.
    """
    corners = [[x, y, z] for x in (-0.3, 0.3) for y in (-0.5, 0.5) for z in (0.0, 1.0)]
    points = np.array(corners) * scale + shift
    lines = _format_box(points)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "box.obj"
        path.write_text("\n".join(lines) + "\n")
        return workbench.load_scene(path).description.object


def _format_box(points: np.ndarray) -> list[str]:
    """Return the lines of an OBJ file with a box.

    Args:
        points: (8, 3) corners of the box. x changes slowest, z fastest.
    """
    # Each quad lists its corners counterclockwise as seen from outside.
    quads = [
        [0, 4, 6, 2],
        [1, 3, 7, 5],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 2, 3, 1],
        [4, 5, 7, 6],
    ]
    lines = [f"v {x:.12g} {y:.12g} {z:.12g}" for x, y, z in points]
    for a, b, c, d in quads:
        # two triangles of each quad; OBJ counts corners from 1
        for face in ((a, b, c), (a, c, d)):
            lines.append("f " + " ".join(str(1 + corner) for corner in face))
    return lines


def make_file_arguments(scale: float = 1.0, shift: float = 0.0) -> dict[str, object]:
    """Return arguments of `check_scene` for a box in another file.

    Objects are scaled to a common size and position when they are imported. So the box
    has to look like the one of `import_box()`, which is the other scene. Its gradient
    is not compared, to save time.

    Args:
        scale: factor on the size of the box in the file.
        shift: distance of the box from the origin of the file.
    """
    thing = partial(import_box, scale, shift)
    return {
        "controls": SHIFT,
        "thing": thing,
        "compare": False,
        "other_scene": {"thing": import_box},
    }


def make_outline_arguments(controls: ControlSettings) -> dict[str, object]:
    """Return arguments of `check_scene` for a dark mug in front of nothing."""
    return {
        "controls": controls,
        "thing": make_dark_mug,
        "settings": NO_GROUND,
        "u": [0.5],
    }


EMPTY_VIEW = {"controls": {"pose": {"z": [-3.0, -2.0]}}, "settings": {"pose.x": 9e3}}
register_cases(
    "geometry",
    check_scene,
    [
        (
            "degenerate-triangles",
            "Faces without area change neither the picture nor the gradient.",
            make_mesh_arguments(DEGENERATE, SQUARE),
        ),
        (
            "sliver-triangles",
            "A triangle a million times as long as wide leaves everything "
            "finite and right.",
            make_mesh_arguments(SLIVER),
        ),
        (
            "coincident-faces",
            "Two faces in one place look like one.",
            make_mesh_arguments(COINCIDENT_SQUARES, SQUARE),
        ),
        (
            "one-triangle",
            "Finite, and both gradients are right.",
            make_mesh_arguments(TRIANGLE),
        ),
        (
            "scale-0.01",
            FINITE,
            {
                "controls": {"pose": {"scale": [0.01, 0.02]}},
                "u": [0.0],
                "compare": False,
            },
        ),
        (
            "scale-100",
            FINITE,
            {
                "controls": {"pose": {"scale": [50.0, 100.0]}},
                "u": [1.0],
                "compare": False,
            },
        ),
        (
            "file-in-units-of-0.01",
            "A file in other units gives the same picture.",
            make_file_arguments(0.01),
        ),
        (
            "file-in-units-of-100",
            "A file in other units gives the same picture.",
            make_file_arguments(100.0),
        ),
        (
            "file-10000-sizes-off",
            "A mesh that its file puts 10,000 sizes from the origin "
            "gives the same picture.",
            make_file_arguments(shift=1e4),
        ),
        (
            "translation-10000",
            "The picture is that of the scene without the object, and "
            "the gradient is zero.",
            {
                "controls": {"pose": {"y": [9e3, 1e4]}},
                "u": [1.0],
                "gradient": (None, 1e-6),
                "other_scene": EMPTY_VIEW,
            },
        ),
        (
            "grazing-view",
            "Looking along the ground, the gradient by the elevation is right.",
            make_outline_arguments({"camera": {"elevation": [-10.0, 10.0]}}),
        ),
        (
            "near-plane",
            "With the camera inside the object, picture and gradient are finite.",
            {
                "controls": {"camera": {"distance": [0.05, 0.2]}},
                "u": [0.5],
                "compare": False,
            },
        ),
        (
            "object-fills-the-frame",
            "Finite where nothing but the object is seen.",
            {
                "controls": {"camera": {"distance": [0.5, 0.8], "fov": 10.0}},
                "u": [0.5],
                "compare": False,
            },
        ),
        (
            "object-leaves-the-frame",
            "Half outside, the gradient by the shift is right.",
            make_outline_arguments({"pose": {"x": [0.0, 2.0]}}),
        ),
    ],
)


@register_case("geometry", "million-triangles", slow=True)
def million() -> CaseOutcome:
    """Finite, right, and like the coarse mesh of the same shape.

    The mesh is a sphere of a million triangles. `check_scene` checks the gradient by
    its texture; the gradient by a shift has to be finite.
    """
    # 1000 columns and 501 rows give about 2 * 1000 * 500 triangles.
    fine_mesh = assets.normalise_mesh(workbench.make_sphere(501, 1000))
    coarse_mesh = assets.normalise_mesh(workbench.make_sphere(64, 128))
    coarse = make_renderer(SHIFT, make_checkered_object(coarse_mesh))
    fine = make_renderer(SHIFT, make_checkered_object(fine_mesh))
    loss = gradients.make_smooth_loss(fine.formation.resolution)
    _, slope = fine.gradient(loss, fine.start, 0, SPP)
    is_finite = bool(torch.isfinite(slope).all())
    difference = compute_mean_difference(
        render_image(fine, fine.start, seed=0, spp=REFERENCE_SPP),
        render_image(coarse, coarse.start, seed=0, spp=REFERENCE_SPP),
    )
    scene = check_scene(TEXTURE, make_checkered_object(fine_mesh), evaluations=2)
    return scene.with_checks(
        check_range("triangles", float(len(fine_mesh.faces)), min_value=1e6),
        check_condition("the gradient by a shift is finite", is_finite),
        check_range(
            "mean difference from a sphere of 16,000",
            difference,
            max_value=MAX_PICTURE_DIFFERENCE,
        ),
    )


@register_case("geometry", "gimbal-angles", slow=True)
def gimbal() -> CaseOutcome:
    """At a pitch of 90 degrees the gradients by angles and by the rotation vector are
    right.

    At this pitch, yaw and roll rotate about the same axis (gimbal lock).
    """
    angles = {
        "pose": {
            "yaw": [-90.0, 90.0],
            "pitch": [45.0, 135.0],
            "roll": [-90.0, 90.0],
            "on_ground": "no",
        }
    }
    # At this pitch, a yaw of 36 degrees gives the same pose as a roll of -36. In u these
    # are the fractions 0.7 and 0.3 of the range from -90 to 90.
    yawed_u = [0.7, 0.5, 0.5]
    rolled_u = [0.5, 0.5, 0.3]
    by_angles = make_renderer(angles, make_dark_mug, settings=NO_GROUND)
    yawed = render_image(by_angles, torch.tensor(yawed_u))
    rolled = render_image(by_angles, torch.tensor(rolled_u))
    vector_check = _check_rotation_vector()
    scene = check_scene(
        angles, make_dark_mug, settings=NO_GROUND, u=yawed_u, spp=2 * SPP
    )
    pose_check = check_range(
        "mean difference of yaw 36 and roll -36",
        compute_mean_difference(yawed, rolled),
        max_value=MAX_PICTURE_DIFFERENCE,
    )
    return scene.with_checks(pose_check, vector_check)


def _check_rotation_vector() -> Check:
    """Check the gradient by the rotation vector near a pitch of 90 degrees."""
    # The rotation vector is searched around the pitch of 90 degrees; the comparison is
    # a little off the start.
    vector = {"pose": {"rotation": [-90.0, 90.0], "pitch": 90.0, "on_ground": "no"}}
    by_vector = make_renderer(vector, make_dark_mug, settings=NO_GROUND)
    rows = compare_gradient(by_vector, by_vector.start + 0.1, seeds=(3, 5))
    return check_range(
        "gradient error of the rotation vector",
        max(row.excess for row in rows),  # the error that noise does not explain
        max_value=MAX_GRADIENT_ERROR,
    )


def full_turn(controls: ControlSettings) -> CaseOutcome:
    """Check that 0 and 360 degrees are the same angle.

    Image and gradient have to be equal, and a step past 360 degrees has to continue at
    0.

    Args:
        controls: a control with one angle, whose range is 0 to 360 degrees.
    """
    renderer = make_renderer(controls)
    zero = torch.zeros_like(renderer.start)
    full = torch.ones_like(renderer.start)
    gradient_check = _compare_turn_gradients(renderer, zero, full)
    difference = compute_mean_difference(
        render_image(renderer, zero), render_image(renderer, full)
    )
    # 1 in u is 360 degrees, the same as 0. So a step of 0.01 past it has to lead to
    # 0.01.
    past_end = make_domain(renderer).project(full + 0.01)
    return check_scene(controls, u=[0.0], compare=False).with_checks(
        check_range(
            "mean difference of the pictures",
            difference,
            max_value=MAX_PICTURE_DIFFERENCE,
        ),
        gradient_check,
        # The configuration is one angle.
        check_range(
            "where a step of 0.01 past the end goes",
            float(past_end.max()),
            min_value=0.0099,
            max_value=0.0101,
        ),
    )


def _compare_turn_gradients(
    renderer: gradients.Renderer, zero: Tensor, full: Tensor
) -> Check:
    """Check that the gradients at 0 and at 360 degrees, two configurations, are equal."""
    loss = gradients.make_smooth_loss(renderer.formation.resolution)
    _, zero_slope = renderer.gradient(loss, zero, 0, SPP)
    _, full_slope = renderer.gradient(loss, full, 0, SPP)
    slope_difference = float((zero_slope - full_slope).abs().max())
    return check_range(
        "difference of the gradients",
        slope_difference / float(zero_slope.abs().max()),
        max_value=0.05,
    )


FULL_TURN = (
    "0 and 360 degrees give one picture and one gradient, and a step goes on "
    "across "
    "the seam."
)
for control, name in (
    ("pose", "yaw"),
    ("camera", "azimuth"),
    ("environment", "rotation"),
):
    controls: ControlSettings = {control: {name: [0.0, 360.0]}}
    register_cases(
        "geometry",
        full_turn,
        [(f"full-turn-{control}-{name}", FULL_TURN, {"controls": controls})],
    )


# ---- `stability`: stiff and extreme scenes, and whether each of them holds


def run_cases(context: RunContext[StabilityConfig]) -> StabilityResult:
    """Run cases of the suite in order.

    The run ends after the last case, when its time is over, or with Ctrl-C. The result
    of a case is stored at once: a resumed run continues with the next case.
    """
    cases = select_cases(context.config.cases, context.config.groups)
    measurements = context.open_measurements(context.config.seconds)
    progress = context.progress

    def measure_rows() -> Iterator[CaseRow]:
        """Yield the row of each case, and report those that are measured now."""
        hint = "`case` and `group` select some, `seconds` stops before the next one"
        progress.stage("trying stiff and extreme scenes", len(cases), hint=hint)
        for case in cases:
            is_stored = measurements.read_stored(case.name) is not None
            row = measurements.get_or_measure_row(case.name, CaseRow, case.run)
            # The caller may stop here if the time is over. Then nothing is reported.
            yield row
            if not is_stored:
                progress.message(f"{case.name}: {row.status}, {row.seconds:.1f} s")
            progress.advance(1)

    def make_result(rows: list[CaseRow]) -> StabilityResult:
        """Return the result with the rows so far."""
        not_run = [case.name for case in cases[len(rows) :]]
        return context.result(StabilityResult, rows=rows, not_run=not_run)

    return measurements.make_result_of_rows(measure_rows(), make_result)


def sentences() -> dict[str, str]:
    """Return for each case, by its name, its group and what must hold."""
    return {case.name: f"{case.group}: {case.holds}" for case in ALL_CASES}


def select_cases(names: Sequence[str] = (), groups: Sequence[str] = ()) -> list[Case]:
    """Select cases by their names and groups; all if neither is given.

    Raises:
        UnknownNameError: if a name or a group does not exist.
    """
    for kind, attribute, requested in (
        ("case", "name", names),
        ("group", "group", groups),
    ):
        known = dict.fromkeys(getattr(case, attribute) for case in ALL_CASES)
        for name in requested:
            if name not in known:
                raise errors.UnknownNameError(kind, name, known)
    if not names and not groups:
        return list(ALL_CASES)
    return [case for case in ALL_CASES if case.name in names or case.group in groups]


# ---- Controls whose scales differ by a million, and noise
# A search works in the unit box, so that units of controls do not matter. What matters
# is how strongly the objective depends on each value there: its curvatures. The ratio
# of the largest to the smallest (the condition number) is reported.

# factor on an objective that must not change a search
RATIO = 1e6


def estimate_hessian(
    value: Callable[[Tensor], float],
    u: Tensor,
    directions: Tensor,
    steps: Sequence[float],
) -> Tensor:
    """Estimate second derivatives (k, k), float64, of an objective f by differences.

    These are central differences with steps h. On the diagonal they are (f(+) - 2 f +
    f(-)) / h^2, elsewhere (f(++) - f(+-) - f(-+) + f(--)) / (4 h_i h_j), where + and -
    are steps forwards and backwards along the directions i and j.

        value: the objective f.
        u: the configuration (d,) at which the derivatives are estimated.
        directions: directions (k, d) of the differences.
        steps: (k,) size of the step along each direction.
    """
    moves = [
        step * direction for step, direction in zip(steps, directions, strict=True)
    ]
    center = value(u)
    hessian = torch.zeros(len(moves), len(moves), dtype=torch.float64)
    for i, move in enumerate(moves):
        curvature = value(u + move) - 2.0 * center + value(u - move)
        hessian[i, i] = curvature / steps[i] ** 2
        for j, other in enumerate(moves[:i]):
            mixed = value(u + move + other) - value(u + move - other)
            mixed += value(u - move - other) - value(u - move + other)
            hessian[i, j] = mixed / (4.0 * steps[i] * steps[j])
            hessian[j, i] = hessian[i, j]
    return hessian


def condition_number(hessian: Tensor) -> float:
    """Return the ratio of the largest to the smallest absolute eigenvalue.

    The matrix (k, k) is symmetric. The ratio is infinite if the smallest is 0.
    """
    magnitudes = torch.linalg.eigvalsh(hessian.double()).abs()
    if not float(magnitudes.min()) > 0.0:
        return math.inf
    return float(magnitudes.max() / magnitudes.min())


@register_case("stiff", "badly-scaled-range")
def wide_range() -> CaseOutcome:
    """The derivative does not depend on how wide the searched range is."""
    wide_slope = _measure_shift_slope(half_width=1e4)
    narrow_slope = _measure_shift_slope(half_width=0.3)
    error = abs(wide_slope / narrow_slope - 1.0)
    error_check = check_range(
        "error of the derivative per object size", error, max_value=0.2
    )
    scene = check_scene({"pose": {"x": [-1e4, 1e4]}}, compare=False)
    return scene.with_checks(error_check, relative_error=error)


def _measure_shift_slope(half_width: float) -> float:
    """Return the derivative of a smooth loss by a shift of one object size.

    It is the mean over 6 seeds.

    Args:
        half_width: the shift is searched in [-half_width, half_width], in object sizes.
    """
    renderer = make_renderer({"pose": {"x": [-half_width, half_width]}})
    loss = gradients.make_smooth_loss(renderer.formation.resolution)
    derivatives = []
    for seed in range(6):
        _, gradient = renderer.gradient(loss, renderer.start, seed, 32)
        derivatives.append(float(gradient[0]))
    # The derivatives are by u, which goes from 0 to 1 over the range. Divided by the
    # width of the range, they are by the shift.
    return statistics.fmean(derivatives) / (2.0 * half_width)


@register_case("stiff", "light-rotation-texel", slow=True)
def light_rotation_texel() -> CaseOutcome:
    """All three move, the condition number is printed, and the objective's unit does
    not matter.

    The three are the power of a light, a rotation and texels, whose units and
    curvatures differ. A search of the same objective times 1e6 has to take the same
    path. The condition number is that of the Hessian.
    """
    controls: ControlSettings = {
        "light": {"type": "point", "power": [0.0, 12.0], "x": 1.0, "y": -1.0, "z": 2.0},
        "pose": {"yaw": [0.0, 360.0]},
        "texture": {"resolution": 2},
    }
    renderer = make_renderer(controls)
    u = renderer.start.clone()
    u[:2] = torch.tensor([0.5, 0.1])  # power and rotation; texels follow
    hessian = _estimate_three_curvatures(renderer, u)
    path, _ = _record_path(renderer, u, scale=1.0)
    scaled_path, ending = _record_path(renderer, u, scale=RATIO)
    path_difference = float((path - scaled_path).abs().max())
    scene = check_scene(controls, u={0: 0.5, 1: 0.1}, compare=False)
    return scene.with_checks(
        *_check_movement(path),
        check_range(
            "distance from the path of the objective x 1e6",
            path_difference,
            max_value=1e-3,
        ),
        ending=ending,
        measurements=_compute_condition_numbers(hessian),
    )


def _check_movement(path: Tensor) -> list[Check]:
    """Check that power, rotation and texels moved along a path (steps, d)."""
    distances = (path - path[0]).abs().amax(dim=0)
    texel_distance = float(distances[2:].max())
    return [
        check_range("how far the power moved", float(distances[0]), min_value=0.05),
        check_range("how far the rotation moved", float(distances[1]), min_value=0.05),
        check_range("how far the texels moved", texel_distance, min_value=0.05),
    ]


def _compute_condition_numbers(hessian: Tensor) -> dict[str, float]:
    """Compute condition numbers of a Hessian (3, 3) in u, and in other units."""
    # One watt is 1/12 in u, as the range of the power is 12 W; one degree is 1/360; and
    # sRGB values of texels are those in u.
    unit_in_u = torch.tensor([1.0 / 12.0, 1.0 / 360.0, 1.0]).double()
    hessian_in_units = torch.diag(unit_in_u) @ hessian @ torch.diag(unit_in_u)
    in_units = condition_number(hessian_in_units)
    return {
        "condition number in u": condition_number(hessian),
        "condition number in watts, degrees and sRGB": in_units,
    }


def _estimate_three_curvatures(renderer: gradients.Renderer, u: Tensor) -> Tensor:
    """Estimate second derivatives (3, 3) by power, by rotation, and by all texels.

    A configuration has the power, the rotation, and the texels, in this order. The
    third direction changes all texels equally.
    """
    loss = gradients.make_smooth_loss(renderer.formation.resolution)
    directions = torch.zeros(3, len(u))
    directions[0, 0] = 1.0
    directions[1, 1] = 1.0
    directions[2, 2:] = 1.0
    # Steps of the differences by power, rotation and texels, large enough for the noise.
    # The plan has a group for each parameter; that of the rotation is the second.
    rotation_group = renderer.plan.groups[1]
    steps = [0.2, rotation_group.step * 2.0, 0.08]

    def objective(configuration: Tensor) -> float:
        """Return the objective in logits."""
        image = render_image(renderer, configuration, seed=0, spp=REFERENCE_SPP)
        return LOGIT_SCALE * float(loss(image))

    return estimate_hessian(objective, u, directions, steps)


def _record_path(
    renderer: gradients.Renderer, u: Tensor, scale: float
) -> tuple[Tensor, str]:
    """Search with a scaled objective; return the configurations (steps, d) and status.

    Args:
        renderer: renderer of the scene.
        u: configuration at which the search starts (d,).
        scale: factor on the objective, which must not change the path.
    """
    loss = gradients.make_smooth_loss(renderer.formation.resolution)
    path: list[Tensor] = []
    result = run_search(
        renderer,
        lambda image: scale * loss(image),
        steps=18,
        spp=8,
        start=u,
        on_step=lambda record, configuration, evaluation: path.append(configuration),
    )
    return torch.stack(path), result.ending.value


MIXED = {
    "texture": {"resolution": 8},
    "environment": {"exposure": [-1.0, 1.0]},
    "pose": {"y": [-0.3, 0.3]},
}
register_cases(
    "noise",
    check_scene,
    [
        (
            "one-sample-a-pixel",
            "Finite; the mean of 48 gradients is right.",
            {"controls": MIXED, "spp": 1, "repeats": 48, "slow": True},
        ),
        (
            "one-sample-a-pixel-denoised",
            "Finite after the denoiser too.",
            {
                "controls": {"texture": {"resolution": 8}},
                "spp": 1,
                "denoise": "oidn",
                "compare": False,
            },
        ),
    ],
)


@register_case("noise", "heavy-tails-of-a-moving-mesh", slow=True)
def heavy_render(count: int = 24) -> CaseOutcome:
    """The plan takes differences of the loss for what moves a mesh, which have no heavy
    tail.

    The farthest sample may be at most 12 median distances from the median. For 24
    Gaussian samples, that is exceeded less than once in 1,000 trials.
    """
    controls = {"pose": {"x": [-0.3, 0.3]}}
    renderer = make_renderer(controls).copy_with(transfer="linear")
    renderer.plan = renderer.plan.with_pixel_steps()
    slopes = _sample_slopes(renderer, count)
    # There is one entry, the derivative by the shift.
    distance = (slopes - slopes.median()).abs()
    takes_secant = renderer.plan.groups[0].estimator == "secant"
    return check_scene(controls, compare=False, spp=4).with_checks(
        check_range(
            "farthest over the median distance",
            float(distance.max() / distance.median()),
            max_value=12.0,
        ),
        check_condition("the plan takes secant", takes_secant),
    )


def _sample_slopes(renderer: gradients.Renderer, count: int) -> Tensor:
    """Return gradients (count, d) of a smooth loss at the start, float64.

    Each has 4 samples per pixel and its own seed.
    """
    loss = gradients.make_smooth_loss(renderer.formation.resolution)
    gradient_samples = []
    for seed in range(count):
        _, gradient = renderer.gradient(loss, renderer.start, seed, 4)
        gradient_samples.append(gradient)
    return torch.stack(gradient_samples).double()
