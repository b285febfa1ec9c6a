"""One search step over its floor: what advsearch adds to bare Mitsuba and bare torch.

The floor is measured in the same process, at the same sizes, turn by turn with the step itself: a bare primal render
and a bare adjoint by Mitsuba's own calls, nothing recorded, and the model forward and backward on a fixed picture.
With the denoiser, bare Open Image Denoise and the render of its guides are part of the floor too.

    python benchmarks/step.py [--repeats 21] [--spp 16]

A ratio of 1 means that everything else (colour, projection, momentum, bookkeeping, copies) is free; less than 1, that
recorded kernels save more than all of that costs.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from advsearch import seeds, threads

threads.configure()

from advsearch.attacks import Query, get_objective, make_policy  # noqa: E402
from advsearch.controls import make_space  # noqa: E402
from advsearch.controls.texture import TextureControl  # noqa: E402
from advsearch.engine.loading import load_scene, make_renderer  # noqa: E402
from advsearch.engine.problem import Problem  # noqa: E402
from advsearch.models import load_model  # noqa: E402
from advsearch.scene.description import SceneDescription  # noqa: E402
from advsearch.scene.formation import EVERYTHING  # noqa: E402
from advsearch.scene.mitsuba_backend.scene import BASE_COLOR, MitsubaScene  # noqa: E402
from advsearch.scene.mitsuba_backend.variant import mitsuba  # noqa: E402
from advsearch.tasks import Classification, Facts  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=21, help="turns after three that are not counted (default 21)")
    parser.add_argument("--spp", type=int, default=16, help="samples a pixel (default 16)")
    args = parser.parse_args()
    print("one search step over bare Mitsuba + bare torch (median of the turns; quartiles)")
    for size, limit in ((224, 1.05), (64, 1.05)):
        for denoise in ("none", "oidn"):
            low, middle, high = compare(size, denoise, args.spp, args.repeats)
            ratio = f"{middle:.2f}  ({low:.2f}-{high:.2f})"
            print(f"  {size:3d} x {size:<3d} denoise {denoise:4s}  {ratio}  asked for {limit:.2f}")


def compare(size: int, denoise: str, spp: int, repeats: int) -> tuple[float, float, float]:
    """Return the quartiles of step time over floor time."""
    description = load_scene("mug").description
    space = make_space([TextureControl()], description)
    model = load_model("reference")
    task = Classification().on(model)
    renderer = make_renderer(description, space, size, denoise, 0)
    problem = Problem(renderer, space, model, task, lambda *_: Facts("mug", "mug"), get_objective("margin"), spp, 0)
    floor = Floor(description, size, spp, denoise, lambda image: model(image)[0, model.label_set("mug").indices[0]])
    step = steps(problem, 3 + repeats)
    ratios = []
    for turn in range(3 + repeats):
        parts = floor.turn(turn), clock(step)
        if turn >= 3:
            ratios.append(parts[1] / parts[0])
    low, middle, high = statistics.quantiles(ratios, n=4)
    return low, middle, high


def steps(problem: Problem, count: int) -> Callable[[], None]:
    """Return a function that takes the next step of a search: propose, render, classify, differentiate, update."""
    policy = make_policy("pgd")
    state = policy.start(problem.domain, torch.Generator().manual_seed(0), count)
    index = 0

    def step() -> None:
        nonlocal state, index
        (proposal,), state = policy.propose(state, 1)
        query = Query(proposal.u, seeds.stream(0, "search", index), number=index, phase="search", gradient=True)
        state = policy.update(state, [(proposal.u, problem.evaluate(query))])
        index += 1

    return step


class Floor:
    """The same work by Mitsuba's, Open Image Denoise's and torch's own calls, nothing around them."""

    def __init__(
        self, description: SceneDescription, size: int, spp: int, denoise: str, score: Callable[[Tensor], Tensor]
    ) -> None:
        self.mi = mitsuba()
        holder = MitsubaScene(description, (size, size), leave_out=EVERYTHING - {"tracing"})
        self.scene = holder._scene
        self.path, self.guides = holder._integrator("path"), holder._integrator("guides")
        self.parameters, self.key = holder.parameters, holder.declared[BASE_COLOR][0]
        self.holder, self.spp, self.denoise, self.score = holder, spp, denoise, score
        self.texture = self.mi.TensorXf(self.parameters[self.key])
        self.cotangent = self.mi.TensorXf(torch.full((size, size, 3), 1e-3))
        self.picture = torch.rand(size, size, 3, generator=torch.Generator().manual_seed(0))

    def turn(self, seed: int) -> float:
        """Do all of it once; return the seconds."""
        total = clock(lambda: self.primal(seed)) + clock(lambda: self.adjoint(seed + 10_000)) + clock(self.network)
        if self.denoise == "oidn":
            total += clock(lambda: self.denoised(seed))
        return total

    def primal(self, seed: int) -> None:
        import drjit as dr

        image = self.mi.render(self.scene, integrator=self.path, spp=self.spp, seed=seed)
        dr.eval(image)
        dr.sync_thread()

    def adjoint(self, seed: int) -> None:
        import drjit as dr

        texture = self.mi.TensorXf(self.texture)
        dr.enable_grad(texture)
        self.parameters[self.key] = texture
        self.parameters.update()
        self.path.render_backward(self.scene, self.parameters, self.cotangent, sensor=0, seed=seed, spp=self.spp)
        dr.eval(dr.grad(texture))
        dr.sync_thread()

    def network(self) -> None:
        picture = self.picture.clone().requires_grad_()
        self.score(picture).backward()

    def denoised(self, seed: int) -> None:
        import drjit as dr
        import mitsuba_oidn

        both = self.mi.render(self.scene, integrator=self.guides, spp=self.spp, seed=seed)
        dr.eval(both)
        dr.sync_thread()
        mitsuba_oidn.denoise(self.picture, self.picture, self.picture, hdr=True)


def clock(work: Callable[[], None]) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


if __name__ == "__main__":
    main()
