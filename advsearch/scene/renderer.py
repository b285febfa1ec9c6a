"""The function in the middle: `render(u, seed, spp)`, differentiable in ordinary torch
autograd.

See docs/design.md, "One function in the middle".

    u in [0, 1]^d --space--> scene inputs --assembly, Mitsuba--> radiance --image
    formation--> (H, W, 3) sRGB in [0, 1]

The arrows outside Mitsuba are torch operations and differentiate themselves. Mitsuba's
is a custom autograd function whose backward pass renders the adjoint with a seed of its
own. Coordinates that the gradient plan gives to differences get their derivative from a
second one, which is the identity in the forward pass.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch import seeds
from advsearch.errors import InputError
from advsearch.pictures import png_of
from advsearch.scene.assembly import ON_PICTURE, Motion, central
from advsearch.scene.color import levels_of
from advsearch.scene.description import OBJECT, SceneDescription
from advsearch.scene.formation import ImageFormation, Later, Moment, Surfaces
from advsearch.scene.geometry import camera_to_world, middle
from advsearch.scene.gradients import (
    BY_ADJOINT,
    BY_DIFFERENCES,
    TURN_STEP,
    Group,
    first_order,
    first_plan,
    steps_for,
)
from advsearch.scene.mitsuba_backend.denoise import denoise
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.rig import Mount

MAX_SPP = 65536
# a point of the unit box
Configuration = Tensor | npt.NDArray[np.floating[Any]] | Sequence[float]
# from inputs, seed and spp to radiance (H, W, 3)
Source = Callable[[Mapping[str, Tensor], int, int], Tensor]
Predict = Callable[[Mapping[str, Tensor]], Tensor]
"""From scene inputs to linear radiance (H, W, 3), or (H, W, 4) with coverage where
there is a backdrop; differentiable.
"""


class InputSpace(Later, Protocol):
    """What the renderer and a loop of one's own ask of a space: its start, its groups,
    what a configuration does.
    """

    @property
    def start(self) -> Tensor:
        """(d,) float32 in [0, 1]: the unchanged scene."""

    @property
    def groups(self) -> tuple[Group, ...]:
        """Every group of coordinates with its valid estimators."""

    def later(self, seconds: float) -> Later:
        """Return what maps u to scene inputs so many seconds later."""

    def picture(self, u: Tensor, image: Tensor) -> Tensor:
        """Change the finished picture; differentiable."""

    def printed(self, u: Tensor) -> dict[str, Tensor]:
        """Return the colours that are searched, (h, w, 3) or (h, w, 4), by control;
        differentiable.
        """

    def numbers(self, u: Tensor) -> dict[str, Tensor]:
        """Return the numbers of the configuration, in their units, by name;
        differentiable.
        """


# coordinates of a group up to which it is measured how far they move outlines
MOST_MEASURED = 64
# of noise, over which the tone curve is straight; see `Renderer.halves`
SMALL_PART = 0.0625


class Renderer:
    """Renders the configurations of one space in one scene.

    Attributes:
        start: (d,) float32 in [0, 1], the configuration that leaves the scene as it is.
        plan: how each coordinate is differentiated; may be replaced.
        routes: which scene inputs each group of coordinates reaches, by
            `control.parameter`.
        renders: number of primal renders so far, those of differences included.
        gradients: number of adjoint renders so far.
        non_finite: number of pixels and gradient entries that were NaN or infinite and
            were set to zero.

    Args:
        scene: the scene inside Mitsuba, at the formation's resolution.
        space: maps u to scene inputs.
        formation: how radiance becomes the picture.
        root_seed: seeds of different roots never meet, whatever is passed as `seed`.
        moments: that a picture is the mean of, while something moves; empty of a still.
        motion: measures how fast coordinates move points; None takes the default step
            for all.
        estimators: estimators forced by "control.parameter", "control" or "*".
    """

    def __init__(
        self,
        scene: MitsubaScene,
        space: InputSpace,
        formation: ImageFormation,
        root_seed: int = 0,
        *,
        motion: Motion | None = None,
        estimators: Mapping[str, str] | None = None,
        moments: Sequence[Moment] = (),
    ) -> None:
        self.scene = scene
        self.space = space
        self.formation = formation
        self.moments = tuple(moments)
        self.root_seed = root_seed
        self._shape = space.start.shape
        self._source: Source | None = None
        self._predict: Predict | None = None
        self.renders = self.gradients = self.non_finite = 0
        self._left_out: frozenset[str] = frozenset()
        groups = space.groups
        self.plan = first_plan(
            groups,
            self._steps(groups, motion),
            estimators,
            across=max(formation.resolution),
        )
        self.routes = self._find_routes(groups)

    @property
    def start(self) -> Tensor:
        return self.space.start

    def __repr__(self) -> str:
        height, width = self.formation.resolution
        numbers = ", ".join(
            f"{group.name} ({group.size})" for group in self.space.groups
        )
        return (
            f"Renderer({len(self.start)} numbers: {numbers}; {height} x {width} pixels)"
        )

    def _repr_png_(self) -> bytes:
        """The start as a notebook shows it; it does not count as a render."""
        with torch.no_grad():
            return png_of(levels_of(self.like()(self.start)).numpy())

    @property
    def composed(self) -> str:
        """Why a picture is not that of one scene as one camera sees it; empty where it
        is, so that others may predict it from light that was collected once.
        """
        if self.scene.made[0].rig:
            return "a picture is made of those of several cameras"
        return "a picture is made of several moments" if self.moments else ""

    def like(
        self,
        scene: MitsubaScene | None = None,
        *,
        source: Source | None = None,
        predict: Predict | None = None,
        **formation: Any,
    ) -> Renderer:
        """Return a renderer of the same space that counts on from this one's counters,
        by itself: with another scene, other fields of the image formation, a `source`
        (another program, which renders and denoises), or what predicts radiance
        (`scene.predictor`): seed and samples of a call mean nothing then, and every
        derivative runs back through scene inputs, whatever the plan says.
        """
        other = copy.copy(self)
        other.formation = replace(self.formation, **formation)
        other.scene = scene or self.scene
        other._source = source or self._source
        other._predict = predict or self._predict
        return other

    def __call__(self, u: Configuration, seed: int = 0, spp: int = 16) -> Tensor:
        """Render a configuration as the model would see it, or several.

        Args:
            u: (d,) in [0, 1], a tensor or an array; or (N, d), rendered one after the
                other with the same seed. It is rendered in float32, whatever its dtype.
            seed: number of the noise; the same seed gives the same bytes.
            spp: independent samples a pixel, 1 to 65,536.

        Returns:
            (H, W, 3) float32, display-referred sRGB in [0, 1], or (N, H, W, 3);
            differentiable with respect to u, in `torch.inference_mode` too (not in
            `torch.no_grad`), and once: a second derivative is an error. The derivative
            has noise of its own and float32 steps, so that `torch.autograd.gradcheck`
            can't pass; `check` compares it with differences that are wide enough.

        Raises:
            InputError: u has another shape, or values outside [0, 1], or spp is out of
                range; or u requires a gradient and was made in `torch.inference_mode`.
        """
        u = _tensor(u)
        if u.ndim == 2 and len(u):
            return torch.stack([self(row, seed, spp) for row in u])
        u, through = self._given(u, spp)
        with _no_inference():
            image = self._picture(through, seed, spp)
            if through is not u and torch.is_grad_enabled() and self._differenced():
                image = _Differences.apply(self, seed, spp, u, image)  # type: ignore[no-untyped-call]
            return image

    def radiance(self, u: Configuration, seed: int = 0, spp: int = 16) -> Tensor:
        """Render linear radiance, denoised if the formation says so; arguments as for a
        call; (H, W, 3) float32. Exposure and backdrop of the configuration are in it;
        what controls do to the finished picture is not.
        """
        _, through = self._given(u, spp)
        with _no_inference():
            return self._picture(through, seed, spp, display=False)

    def halves(self, u: Tensor, seed: int, spp: int) -> tuple[Tensor, Tensor, Tensor]:
        """Trace two pictures (H, W, 3) of a configuration with independent noise, which
        are not denoised; and return beside them that of all their samples, which is.
        Arguments as for a call; without a graph, and not counted. The two are taken
        through a tone curve that is straight about the third, so that they are right on
        average, and not darker where they are noisy; they may leave [0, 1].
        """
        with torch.no_grad():
            inputs = self.scene.assembly(self.space.inputs(u))
            hide = "backdrop.color" in inputs
            traced = _traced(inputs)
            undenoised = self.like(denoiser="none")
            numbers = [seeds.stream(seed, "traced", half) for half in range(2)]
            halves = [
                undenoised.rendered(traced, number, spp, hide) for number in numbers
            ]
            both = (halves[0] + halves[1]) / 2.0
            noise = seeds.stream(self.root_seed, "guides", numbers[0])
            clean = denoise(
                both[..., :3].contiguous(), *self.scene.guides(traced, noise, spp)
            )
            both = torch.cat([clean, both[..., 3:]], dim=-1)
            *noisy, clean = (
                self.finished(picture, inputs, u, display=False)
                for picture in (*halves, both)
            )
            there = self.formation.display(clean)
            moved = (
                self.formation.display(torch.lerp(clean, half, SMALL_PART))
                for half in noisy
            )
            first, second = (
                self.space.picture(u, there + (half - there) / SMALL_PART)
                for half in moved
            )
            return first, second, self.space.picture(u, there)

    def traced_inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Return what the scene gets of a configuration (d,), by name, without a
        graph.
        """
        inputs = self.scene.assembly(self.space.inputs(u))
        return {name: value.detach() for name, value in _traced(inputs).items()}

    def mask(self, u: Configuration) -> Tensor:
        """Return the pixels in which the object is the first thing that the camera
        sees, (H, W) bool. It is asked for at the middle of each pixel. What controls do
        to the finished picture moves nothing in it.
        """
        return self.surfaces(u).seen(OBJECT)

    def surfaces(
        self, u: Configuration, fineness: int = 1, camera: int = 0
    ) -> Surfaces:
        """Return what the camera sees first through the middle of each pixel of u (d,),
        or of each of `fineness` by `fineness` parts of it; as of `mask`. The cameras of
        a rig have numbers from 0.
        """
        u, _ = self._given(u, 1)
        with torch.no_grad():
            rig = self.scene.made[0].rig
            seen = self.scene.surfaces(
                _traced(self._seen(rig[camera] if rig else None, u)), fineness
            )
        metres = self.scene.made[0].metres
        return replace(seen, depth=seen.depth * metres, z_depth=seen.z_depth * metres)

    def gradient(
        self,
        loss: Callable[[Tensor], Tensor],
        u: Tensor,
        seed: int,
        spp: int,
        *,
        free: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Return the loss, from (H, W, 3) sRGB to a number, of the picture of u (d,),
        without graph, and its derivative (d,) float32 by the plan; u, seed and spp as
        in a call. Unlike autograd through a call, this gives coordinates with the
        estimator "secant" differences of the loss; `free` leaves out what takes primal
        renders of its own, with zero for coordinates that use differences.
        """
        self._left_out = BY_DIFFERENCES if free else frozenset({"secant"})
        try:
            with torch.inference_mode(False), torch.enable_grad():
                at = u.detach().clone().requires_grad_()
                value = loss(self(at, seed, spp))
            slope = (
                torch.autograd.grad(value, at, allow_unused=True)[0]
                if value.requires_grad
                else None
            )
        finally:
            self._left_out = frozenset()
        derivative = torch.zeros_like(at) if slope is None else slope
        secants = [
            group
            for group in self.plan.groups
            if group.estimator == "secant" and not free
        ]
        noise = seeds.stream(self.root_seed, "differences", seed)
        count = self.plan.spp or spp
        with torch.no_grad():
            for group in secants:
                central(
                    lambda at: loss(self._picture(at, noise, count)),
                    group,
                    u.detach(),
                    derivative,
                )
        return value.detach(), derivative

    # ---- from u to the picture
    # --------------------------------------------------------------------------------------

    def _given(self, u: Configuration, spp: int) -> tuple[Tensor, Tensor]:
        """Return a configuration as float32, and with a graph only where the derivative
        runs back through scene inputs or the picture; raises as `__call__`.
        """
        u = _tensor(u)
        if u.shape != self._shape:
            raise InputError(
                f"render: expected u of shape {tuple(self._shape)}, got "
                f"{tuple(u.shape)}"
            )
        if not 1 <= spp <= MAX_SPP:
            raise InputError(f"spp: expected 1 to {MAX_SPP} samples a pixel, got {spp}")
        low, high = torch.aminmax(u.detach()) if u.numel() else (u.sum(), u.sum())
        if not bool((low >= 0.0) & (high <= 1.0)):
            raise InputError(
                "render: expected every entry of u in [0, 1]; project u "
                "before you render it"
            )
        if u.is_inference() and u.requires_grad:
            raise InputError(
                "render: u was made in `torch.inference_mode()`, so that nothing can "
                "be differentiated with respect to "
                "it; make it outside, or pass `u.detach()` for the picture alone"
            )
        with _no_inference():
            u = u.clone() if u.is_inference() else u
            if (
                self._predict is not None
                or not u.requires_grad
                or bool((mask := self.plan.through).all())
            ):
                return u, u
            return u, u.detach() + mask * (u - u.detach())

    def _picture(
        self, u: Tensor, seed: int, spp: int, *, display: bool = True
    ) -> Tensor:
        """The picture of u, or its radiance before display; of a rig its cameras' side
        by side, (H, K W, 3).
        """
        renders = self.renders
        views = list[Tensor]()
        for number, mount in enumerate(self.scene.made[0].rig or (None,)):
            noise = seeds.stream(seed, "camera", number) if number else seed
            inputs = self._seen(mount, u)
            hide = "backdrop.color" in inputs
            if self.moments:
                rendered = self._exposed(mount, u, noise, spp, hide)
            else:
                rendered = self.rendered(_traced(inputs), noise, spp, hide)
            views.append(self.finished(rendered, inputs, u, display=display))
        if len(views) == 1:
            return views[0]
        self.renders = renders + 1  # one configuration, as budgets count it
        return torch.cat(views, dim=1)

    def _seen(
        self, mount: Mount | None, u: Tensor, then: Later | None = None
    ) -> dict[str, Tensor]:
        """Scene inputs of u as a camera of a rig, or the only one, sees them: when it
        takes its picture, or `then`.
        """
        space = then or (
            self.space.later(mount.later) if mount and mount.later else self.space
        )
        inputs = self.scene.assembly(space.inputs(u))
        description = self.scene.made[0]
        return (
            mount.seen(inputs, *_standing(description), description.metres)
            if mount
            else inputs
        )

    def _exposed(
        self, mount: Mount | None, u: Tensor, seed: int, spp: int, hide: bool
    ) -> Tensor:
        # the mean radiance of the moments of u, denoised once, which counts as one
        # render
        renders = self.renders
        exposed = torch.zeros(())
        guides = torch.zeros(())
        for number, moment in enumerate(self.moments):
            inputs = _traced(self._seen(mount, u, moment.space))
            noise = seeds.stream(seed, "moment", number)
            rows = moment.rows[:, None, None]
            samples = max(1, math.ceil(spp * moment.samples))
            exposed = exposed + rows * self.rendered(
                inputs, noise, samples, hide, denoised=False
            )
            if self.formation.denoiser == "oidn":
                with torch.no_grad():
                    noise = seeds.stream(self.root_seed, "guides", noise)
                    guides = guides + rows * torch.cat(
                        self.scene.guides(inputs, noise, samples), dim=-1
                    )
        self.renders = renders + 1
        if self.formation.denoiser != "oidn":
            return exposed
        with torch.no_grad():
            noisy = exposed[..., :3].contiguous()
            quick = self.formation.quick
            clean = denoise(
                noisy,
                guides[..., :3].contiguous(),
                guides[..., 3:].contiguous(),
                quick=quick,
            )
            change = torch.cat(
                [clean - noisy, torch.zeros_like(exposed[..., 3:])], dim=-1
            )
        return exposed + change  # whose derivative is that without a denoiser

    def finished(
        self,
        rendered: Tensor,
        inputs: Mapping[str, Tensor],
        u: Tensor,
        *,
        display: bool = True,
    ) -> Tensor:
        """Return the picture of rendered radiance, or the radiance that is to be
        displayed: exposure and backdrop of scene inputs are added, and what controls do
        to the finished picture at u.
        """
        exposure = inputs.get("camera.exposure")
        backdrop = inputs.get("backdrop.color")
        radiance = rendered[..., :3]
        if exposure is not None:
            radiance = radiance * torch.exp2(exposure)
        if backdrop is not None:
            uncovered = (1.0 - rendered[..., 3:]).clamp(0.0, 1.0)
            radiance = radiance + uncovered * (backdrop / self.formation.gain)
        return (
            self.space.picture(u, self.formation.display(radiance))
            if display
            else radiance
        )

    def rendered(
        self,
        inputs: Mapping[str, Tensor],
        seed: int,
        spp: int,
        hide: bool,
        *,
        denoised: bool = True,
    ) -> Tensor:
        """Return linear radiance of scene inputs, (H, W, 3), or (H, W, 4) with coverage
        if the environment is to `hide` behind a backdrop; with a graph; `denoised` if
        the formation says so. What is traced counts in `renders`.
        """
        if self._predict is not None:
            return self._predict(inputs)
        called = self, tuple(inputs), seed, spp, hide, denoised, *inputs.values()
        radiance: Tensor = _Radiance.apply(*called)  # type: ignore[no-untyped-call]
        return radiance

    def finite(self, values: Tensor) -> Tensor:
        """Replace NaN and infinite entries by zero and count them."""
        if bool(torch.isfinite(values.sum())):
            return values
        finite = torch.isfinite(values)
        self.non_finite += int((~finite).sum())
        return torch.where(finite, values, torch.zeros_like(values))

    # ---- differences
    # ------------------------------------------------------------------------------------------------

    def _differenced(self) -> tuple[Group, ...]:
        return self.plan.having(*(BY_DIFFERENCES - self._left_out))

    def differences(self, u: Tensor, cotangent: Tensor, seed: int, spp: int) -> Tensor:
        """Gradient of `sum(cotangent * picture)` for the coordinates that use
        differences; zero for the others. All renders share one seed (common random
        numbers), and the picture is taken after the tone curve and after what controls
        do to it.
        """
        noise = seeds.stream(self.root_seed, "differences", seed)
        spp = self.plan.spp or spp
        derivative = torch.zeros_like(u)
        for group in self._differenced():
            central(
                lambda at: (cotangent * self._picture(at, noise, spp)).sum(),
                group,
                u,
                derivative,
            )
        return self.finite(derivative)

    # ---- set-up
    # -----------------------------------------------------------------------------------------------------

    def _steps(self, groups: tuple[Group, ...], motion: Motion | None) -> Tensor:
        speeds = torch.zeros(len(self.start))
        few = [
            g
            for g in groups
            if {*g.valid} - {"adjoint", "image"} and g.size <= MOST_MEASURED
        ]
        moving = [
            number
            for group in few
            for number in range(group.begin, group.begin + group.size)
        ]
        if motion is not None and moving:
            speeds = motion.speeds(
                lambda u: self.scene.assembly(self.space.inputs(u)), self.start, moving
            )
        steps = steps_for(speeds)
        for group in groups:
            if group.periodic and not bool(speeds[group.coordinates].any()):
                steps[group.coordinates] = TURN_STEP
        return steps

    def _find_routes(self, groups: tuple[Group, ...]) -> dict[str, frozenset[str]]:
        """Which scene inputs each group of coordinates reaches, found by autograd at a
        point inside the box.
        """
        routes: dict[str, set[str]] = {group.name: set() for group in groups}
        if not any(set(group.valid) & BY_ADJOINT for group in groups):
            return {}
        generator = torch.Generator().manual_seed(0)
        noise = torch.rand(self.start.shape, generator=generator)
        at = (0.5 * self.start + 0.25 + 0.1 * (noise - 0.5)).requires_grad_()
        with torch.enable_grad():
            inputs = self.scene.assembly(self.space.inputs(at))
            for name, tensor in inputs.items():
                if not tensor.requires_grad:
                    continue
                weights = torch.rand(tensor.shape, generator=generator)
                (reached,) = torch.autograd.grad(
                    (tensor * weights).sum(), at, retain_graph=True, allow_unused=True
                )
                for group in groups:
                    if reached is not None and bool(reached[group.coordinates].any()):
                        routes[group.name].add(name)
        return {group: frozenset(inputs) for group, inputs in routes.items()}


@lru_cache(maxsize=4)
# which takes a look at every vertex
def _standing(description: SceneDescription) -> tuple[Tensor, Tensor]:
    pose = camera_to_world(description)
    center = middle(description)
    return torch.from_numpy(pose).float(), torch.from_numpy(center).float()


def _traced(inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: value for name, value in inputs.items() if name not in ON_PICTURE}


def _no_inference() -> AbstractContextManager[object]:
    """Ordinary mode inside of torch's inference mode; setting it where it is set
    already would cost time.
    """
    return (
        torch.inference_mode(False)
        if torch.is_inference_mode_enabled()
        else nullcontext()
    )


def _tensor(u: Configuration) -> Tensor:
    try:
        return torch.as_tensor(u, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(
            "render: expected u as a tensor or an array of numbers, got "
            f"{type(u).__name__}"
        ) from None


class _Radiance(torch.autograd.Function):
    """Mitsuba as one torch operation; the adjoint is rendered only if a gradient is
    asked for.
    """

    @staticmethod
    def forward(
        ctx: Any,
        renderer: Renderer,
        names: tuple[str, ...],
        seed: int,
        spp: int,
        hide: bool,
        denoised: bool,
        *tensors: Tensor,
    ) -> Tensor:
        ctx.renderer = renderer
        ctx.names = names
        ctx.seed = seed
        ctx.spp = spp
        ctx.hide = hide
        ctx.save_for_backward(*tensors)
        inputs = dict(zip(names, tensors, strict=True))
        noise = seeds.stream(renderer.root_seed, "primal", seed)
        if renderer._source is None:
            wanted = {"hidden" if hide else "path": noise}
            if denoised and renderer.formation.denoiser == "oidn":
                wanted["guides"] = seeds.stream(renderer.root_seed, "guides", seed)
            rendered, *guides = renderer.scene.pictures(inputs, wanted, spp)
        else:
            rendered = renderer._source(inputs, noise, spp)
            guides = []
        rendered = renderer.finite(rendered)
        for guide in guides:
            noisy = rendered[..., :3].contiguous()
            quick = renderer.formation.quick
            clean = denoise(noisy, guide[..., :3], guide[..., 3:], quick=quick)
            rendered = torch.cat([clean, rendered[..., 3:]], dim=-1) if hide else clean
        renderer.renders += 1
        return rendered

    @staticmethod
    @first_order
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        """Gradient of `sum(cotangent * radiance)` for the inputs whose coordinates use
        an adjoint. The denoiser counts as the identity. An input that no coordinate
        needs is left out.
        """
        renderer: Renderer = ctx.renderer
        inputs = dict(zip(ctx.names, ctx.saved_tensors, strict=True))
        noise = seeds.stream(renderer.root_seed, "gradient", ctx.seed)
        cotangent = renderer.finite(cotangent[..., :3])
        by_input = dict[str, Tensor]()
        left = list(inputs)
        # what two reach goes to the more general one
        for estimator in ("material", "adjoint"):
            groups = [
                group for group in renderer.plan.groups if group.estimator == estimator
            ]
            reached = set[str]().union(
                *(renderer.routes.get(group.name, ()) for group in groups)
            )
            if estimator == "adjoint":
                reached &= renderer.scene.interior
            wrt = [name for name in left if name in reached]
            if not wrt:
                continue
            left = [name for name in left if name not in reached]
            if estimator == "material":
                meshes = sorted({name.rpartition(".")[0] for name in wrt})
                gradients = renderer.scene.material_adjoint(
                    inputs, cotangent, noise, ctx.spp, meshes=meshes
                )
            else:
                method = "hidden" if ctx.hide else "path"
                gradients = renderer.scene.adjoint(
                    inputs, cotangent, noise, ctx.spp, wrt=wrt, method=method
                )
            renderer.gradients += 1
            by_input |= {
                name: renderer.finite(gradient) for name, gradient in gradients.items()
            }
        return (
            None,
            None,
            None,
            None,
            None,
            None,
            *(by_input.get(name) for name in ctx.names),
        )


class _Differences(torch.autograd.Function):
    """The identity on the picture; its backward pass adds the derivative of coordinates
    that use differences.
    """

    @staticmethod
    def forward(
        ctx: Any, renderer: Renderer, seed: int, spp: int, u: Tensor, image: Tensor
    ) -> Tensor:
        ctx.renderer = renderer
        ctx.seed = seed
        ctx.spp = spp
        ctx.save_for_backward(u)
        return image.view_as(image)

    @staticmethod
    @first_order
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        derivative = ctx.renderer.differences(
            *ctx.saved_tensors, cotangent, ctx.seed, ctx.spp
        )
        return None, None, None, derivative, cotangent
