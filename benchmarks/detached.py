"""How a search gets past detectors that cut their queries off from the picture, as RT-DETR does: five ways compared.

    python benchmarks/detached.py [--family RTDetr] [--train 1200] [--starts 20] [--steps 12] [--weights FILE]

RT-DETR, RT-DETRv2, D-FINE, DEIMv2, two-stage Deformable DETR and Grounding DINO choose queries by scores of their
encoder and detach these and their reference points, in evaluation too: a gradient misses how the picture moves them. A
tiny RT-DETR is trained here for minutes on drawn pictures of squares, discs and crosses, or read from FILE. Then the
texture of an object that it finds is changed such that it vanishes, within an l-infinity ball, by `pgd` with the
gradient

- own: of the network as it is;
- attached: where `detach` does nothing;
- encoder: as it is, with the objective of the encoder's own boxes and scores added;
- both: attached, with the same added;

and by `nes` without one; with as many pictures, and again with as many seconds as `attached` takes. Printed are the
cosine of each gradient and differences along random directions, and its length as a share of theirs; then how many of
the starts each way finds, the median of the best objective (log-odds of the confidence less those of the best right
box), and the milliseconds of an evaluation. It runs on one thread.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
import transformers
from torch import Tensor
from torch.nn import functional

from advsearch.attacks import Block, Domain, Evaluate, Evaluation, Query, make_policy, search
from advsearch.models.model import Detaching, mend_batch_norms
from advsearch.tasks.boxes import Place
from advsearch.tasks.detection import Detection

SIDE, TEXELS = 64, 8
NAMES = ("square", "disc", "cross")
EPSILONS = (0.05, 0.15)
SMALL, ALONG = 5e-4, 16
"""Step of the differences that gradients are compared with, and along how many directions."""
MEAN = 0.5


# ---- pictures -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """Things on a ground: kinds (K,), middles and half sides (K, 3) as shares of the picture, textures (K, 3, T, T)."""

    kinds: Sequence[int]
    places: Tensor
    textures: Tensor
    ground: Tensor

    def drawn(self, texture: Tensor | None = None) -> Tensor:
        """Return the picture (3, SIDE, SIDE); `texture` in place of the first thing's."""
        ends = (torch.arange(SIDE) + 0.5) / SIDE
        y, x = torch.meshgrid(ends, ends, indexing="ij")
        picture = functional.interpolate(self.ground[None], (SIDE, SIDE), mode="bicubic").clamp(0.0, 1.0)[0]
        for number in reversed(range(len(self.kinds))):
            (cx, cy, half), kind = self.places[number], self.kinds[number]
            u, v = (x - cx) / half, (y - cy) / half
            across = torch.maximum(u.abs(), v.abs())
            thin = torch.maximum(torch.minimum(u.abs(), v.abs()) * 2.5, across)
            inside = torch.sigmoid((1.0 - (across, torch.hypot(u, v), thin)[kind]) * half * SIDE * 2.0)
            own = self.textures[number] if texture is None or number else texture
            grid = torch.stack([u, v], dim=-1)[None]
            paint = functional.grid_sample(own[None], grid, padding_mode="border", align_corners=False)[0]
            picture = picture + inside * (paint - picture)
        return picture

    def boxes(self) -> Tensor:
        """Return middle and size (K, 4) of each thing, as shares of the picture."""
        return torch.cat([self.places[:, :2], 2.0 * self.places[:, 2:].expand(-1, 2)], dim=1)


def scene(rng: torch.Generator, things: int) -> Scene:
    """Return a scene of things that do not overlap much."""
    kinds = torch.randint(0, len(NAMES), (things,), generator=rng).tolist()
    while True:
        half = 0.1 + 0.12 * torch.rand(things, 1, generator=rng)
        middle = half + (1.0 - 2.0 * half) * torch.rand(things, 2, generator=rng)
        apart = torch.cdist(middle, middle, p=math.inf) + torch.eye(things) * 9.0
        if bool((apart > 0.8 * (half + half.T)).all()):
            break
    colour = torch.rand(things, 3, 1, 1, generator=rng)
    texture = (colour + 0.25 * torch.randn(things, 3, TEXELS, TEXELS, generator=rng)).clamp(0.0, 1.0)
    ground = torch.rand(3, 1, 1, generator=rng) + 0.3 * torch.randn(3, 4, 4, generator=rng)
    return Scene(kinds, torch.cat([middle, half], dim=1), texture, ground.clamp(0.0, 1.0))


# ---- the detector ---------------------------------------------------------------------------------------------------


def made(family: str) -> Any:
    """Return a tiny network without weights."""
    layers: dict[str, Any] = {"embedding_size": 16, "hidden_sizes": [16, 24, 32, 48], "depths": [1, 1, 1, 1]}
    layers |= {"layer_type": "basic", "out_features": ["stage2", "stage3", "stage4"]}
    sizes: dict[str, Any] = {"encoder_hidden_dim": 32, "d_model": 32, "encoder_ffn_dim": 64, "decoder_ffn_dim": 64}
    sizes |= {"encoder_attention_heads": 2, "decoder_attention_heads": 2, "decoder_in_channels": [32] * 3}
    sizes |= {"encoder_in_channels": [24, 32, 48], "decoder_layers": 3, "num_queries": 12, "num_denoising": 12}
    config = getattr(transformers, f"{family}Config")(
        backbone_config=transformers.RTDetrResNetConfig(**layers),
        freeze_backbone_batch_norms=False,
        id2label=dict(enumerate(NAMES)),
        **sizes,
    )
    return getattr(transformers, f"{family}ForObjectDetection")(config)


def trained(family: str, steps: int, batch: int = 16) -> Any:
    """Return a network that finds the things, and say how it got there."""
    torch.manual_seed(0)
    rng, network, began = torch.Generator().manual_seed(1), made(family).train(), time.perf_counter()
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3, weight_decay=1e-4)
    plan = torch.optim.lr_scheduler.OneCycleLR(optimiser, 1e-3, total_steps=steps)
    for step in range(steps):
        scenes = [scene(rng, 1 + step % 3) for _ in range(batch)]
        labels = [{"class_labels": torch.tensor(one.kinds), "boxes": one.boxes()} for one in scenes]
        pictures = torch.stack([one.drawn() for one in scenes])
        loss = network(pixel_values=pictures - MEAN, labels=labels).loss
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 0.5)
        optimiser.step()
        plan.step()
        if step % 100 == 0 or step == steps - 1:
            print(f"  step {step}: loss {loss.item():.3f}, {time.perf_counter() - began:.0f} s", flush=True)
    return network.eval().requires_grad_(False)


# ---- the search -----------------------------------------------------------------------------------------------------


def read(boxes: Tensor, logits: Tensor) -> list[dict[str, Tensor]]:
    """Return a detector's boxes (N, K, 4), middle and size in shares, and its logits as `Detection` takes them."""
    middle, size = boxes.split(2, dim=-1)
    corners = torch.cat([middle - size / 2, middle + size / 2], dim=-1)
    return [{"boxes": one, "scores": each} for one, each in zip(corners, logits.sigmoid(), strict=True)]


TASK = Detection(labels=NAMES, unit="fractions", input_size=(SIDE, SIDE))


@dataclass(frozen=True)
class Search:
    """One start: the first thing of a scene is to vanish."""

    network: Any
    scene: Scene

    @property
    def truth(self) -> Place:
        x, y, half = (self.scene.places[0] * SIDE).tolist()
        left, top, right, bottom = (round(one) for one in (x - half, y - half, x + half, y + half))
        return Place((self.scene.kinds[0],), (left, top, right, bottom), (SIDE, SIDE))

    def scores(self, u: Tensor, way: str = "own") -> tuple[Tensor, Tensor]:
        """Return what success is read off, and what is differentiated."""
        picture = self.scene.drawn(u.reshape(3, TEXELS, TEXELS))[None]
        with Detaching(ignored=True) if way in ("attached", "both") else nullcontext():
            answer = self.network(pixel_values=picture - MEAN)
        mend_batch_norms([answer.pred_boxes, answer.logits, answer.enc_outputs_class])
        found = TASK.score(read(answer.pred_boxes, answer.logits), self.truth)[0]
        if way not in ("encoder", "both"):
            return found, found
        first = read(answer.enc_outputs_coord_logits.sigmoid(), answer.enc_outputs_class)
        return found, found + TASK.score(first, self.truth)[0]

    def slope(self, u: Tensor, way: str) -> tuple[float, Tensor]:
        u = u.clone().requires_grad_()
        found, value = self.scores(u, way)
        return float(found), torch.autograd.grad(value, u)[0]

    def evaluate(self, way: str) -> Evaluate:
        def one(query: Query) -> Evaluation:
            if query.gradient:
                value, slope = self.slope(query.u, way)
            else:
                with torch.no_grad():
                    value, slope = float(self.scores(query.u)[0]), None
            return Evaluation(value, slope, value > 0.0, cost=query.samples)

        return partial(map, one)

    def best(self, policy: str, way: str, epsilon: float, steps: int, seed: int) -> float:
        start = self.scene.textures[0].flatten()
        domain = Domain(start, (Block(start.numel(), "linf", epsilon),))
        result = search(self.evaluate(way), domain, make_policy(policy), steps=steps, seed=seed, candidates=0)
        return max(step.objective for step in result.history)

    def compared(self, rng: torch.Generator) -> dict[str, tuple[float, float]]:
        """Return of each way cosine and relative length of its gradient, by differences along random signs."""
        start = self.scene.textures[0].flatten()
        ways = torch.randint(0, 2, (ALONG, start.numel()), generator=rng) * 2.0 - 1.0
        with torch.no_grad():
            ends = [[float(self.scores(start + sign * SMALL * way)[0]) for sign in (1.0, -1.0)] for way in ways]
        seen = torch.tensor([(high - low) / (2.0 * SMALL) for high, low in ends])
        told = {way: ways @ self.slope(start, way)[1] for way in WAYS}
        return {
            way: (float(functional.cosine_similarity(seen, one, dim=0)), float(one.norm() / seen.norm()))
            for way, one in told.items()
        }


WAYS = ("own", "attached", "encoder", "both")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--family", default="RTDetr", choices=["RTDetr", "RTDetrV2"])
    parser.add_argument("--train", type=int, default=1200)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--weights", type=Path, help="safetensors file to read, or else to write")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.weights and given.weights.exists():
        network = made(given.family)
        safetensors.torch.load_model(network, given.weights)
        network.eval().requires_grad_(False)
    else:
        network = trained(given.family, given.train)
        if given.weights:
            safetensors.torch.save_model(network, str(given.weights))
    rng, tried = torch.Generator().manual_seed(2), 0
    starts: list[Search] = []
    while len(starts) < given.starts:
        one, tried = Search(network, scene(rng, 2)), tried + 1
        with torch.no_grad():
            if float(one.scores(one.scene.textures[0].flatten())[0]) < 0.0:
                starts.append(one)
    print(f"{given.family}: the first thing of {given.starts} in {tried} scenes is found")
    gradients = [one.compared(rng) for one in starts]
    for way in WAYS:
        cosine, length = (statistics.median(one[way][part] for one in gradients) for part in (0, 1))
        print(f"  {way}: cosine {cosine:.2f}, length {length:.2f}", flush=True)
    for epsilon in EPSILONS:
        each = {way: tried_out(starts, "pgd", way, epsilon, given.steps) for way in WAYS}
        each["nes"] = tried_out(starts, "nes", "own", epsilon, given.steps)
        for policy, way, key in (("pgd", "own", "own"), ("pgd", "encoder", "encoder"), ("nes", "own", "nes")):
            tried_out(starts, policy, way, epsilon, round(given.steps * each["attached"] / each[key]))


def tried_out(starts: Sequence[Search], policy: str, way: str, epsilon: float, steps: int) -> float:
    """Search from every start, print how it went, and return the CPU seconds of a step."""
    began = time.process_time()
    found = [one.best(policy, way, epsilon, steps, seed) for seed, one in enumerate(starts)]
    seconds = (time.process_time() - began) / len(starts) / steps
    print(
        f"  epsilon {epsilon}, {policy} {way}, {steps} steps: {sum(one > 0.0 for one in found)} of {len(found)}, "
        f"median {statistics.median(found):+.2f}, {1e3 * seconds:.0f} ms",
        flush=True,
    )
    return seconds


if __name__ == "__main__":
    main()
