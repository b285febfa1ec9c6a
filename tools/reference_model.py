"""Makes the reference model: renders its pictures, trains it, and measures it on
held-out instances and environments.

    python tools/reference_model.py all          (or `make reference`)

Everything comes from one seed. Pictures are kept in a cache folder in blocks, so that a
stopped run goes on where it was. It takes about three quarters of an hour on two cores,
two thirds of it rendering.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from advsearch import threads

COUNTS = {"train": 11_998, "validation": 994, "heldout": 2_002}
"""Pictures of each split; multiples of the 14 classes, so that every class counts the
same.
"""
BLOCK = 500
"""Pictures rendered by one process before a fresh one takes over: Mitsuba does not give
back all memory of a scene.
"""
EPOCHS = 16
LEARNING_RATE = 2e-3

Pictures = np.ndarray[tuple[int, ...], np.dtype[np.uint8]]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one step, or all of them."""
    parser = argparse.ArgumentParser(
        prog="python tools/reference_model.py", description=__doc__
    )
    parser.add_argument("step", choices=["render", "train", "evaluate", "all"])
    parser.add_argument(
        "--cache",
        type=Path,
        default=Path(".cache/reference"),
        help="folder for the pictures",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="root of all randomness (default 0)"
    )
    parser.add_argument(
        "--epochs",
        type=int,
        default=EPOCHS,
        help=f"passes over the pictures (default {EPOCHS})",
    )
    parser.add_argument(
        "--count", type=int, default=None, help="training pictures, to try it on fewer"
    )
    args = parser.parse_args(argv)
    counts = {**COUNTS, **({"train": args.count} if args.count else {})}
    if args.step in ("render", "all"):
        for split in ("heldout", "validation", "train"):
            render(split, counts[split], args.cache, args.seed)
    if args.step in ("train", "all"):
        train(args.cache, counts, args.epochs, args.seed)
    if args.step in ("evaluate", "all"):
        evaluate(args.cache, counts["heldout"], args.seed)
    return 0


# ---- pictures
# ---------------------------------------------------------------------------


def render(split: str, count: int, cache: Path, seed: int) -> None:
    """Render the missing blocks of a split, one process with one thread for each
    core.
    """
    cache.mkdir(parents=True, exist_ok=True)
    jobs = [
        (
            split,
            first,
            min(first + BLOCK, count),
            seed,
            str(_block(cache, split, seed, first)),
        )
        for first in range(0, count, BLOCK)
    ]
    missing = [job for job in jobs if not _complete(Path(job[-1]), job[2] - job[1])]
    context = multiprocessing.get_context("spawn")
    with context.Pool(threads.count_cores(), maxtasksperchild=1) as pool:
        for done, _ in enumerate(
            pool.imap_unordered(_render_block, missing, chunksize=1), start=1
        ):
            print(
                f"{split}: block {done} of {len(missing)} rendered",
                file=sys.stderr,
                flush=True,
            )


def _render_block(job: tuple[str, int, int, int, str]) -> None:
    split, first, last, seed, path = job
    threads.configure(1)
    from reference_scenes import picture

    pictures = np.stack([picture(split, index, seed) for index in range(first, last)])
    part = Path(path).with_suffix(".part.npy")
    np.save(part, pictures)
    part.replace(path)


def _block(cache: Path, split: str, seed: int, first: int) -> Path:
    return cache / f"{split}-{seed}-{first:06d}.npy"


def _complete(path: Path, count: int) -> bool:
    return path.exists() and len(np.load(path, mmap_mode="r")) >= count


def pictures(
    cache: Path, split: str, count: int, seed: int
) -> tuple[Pictures, list[int]]:
    """Return the pictures (N, 128, 128, 3) of a split and their class indices."""
    from reference_scenes import class_of

    blocks = [
        np.load(_block(cache, split, seed, first)) for first in range(0, count, BLOCK)
    ]
    return np.concatenate(blocks)[:count], [class_of(index) for index in range(count)]


# ---- training and measuring
# ---------------------------------------------------------------------------


def train(cache: Path, counts: dict[str, int], epochs: int, seed: int) -> None:
    """Train on the rendered pictures, calibrate on the validation split, and store the
    weights in the package.
    """
    threads.configure(rendering=False)
    import reference_calibration as calibration
    import reference_training as training
    from reference_scenes import labels

    from advsearch.models import reference

    images, truth = pictures(cache, "train", counts["train"], seed)
    held, held_truth = pictures(cache, "validation", counts["validation"], seed)

    def say(at: training.TrainingState) -> None:
        if at.step % 50 == 0:
            print(
                f"step {at.step} of {at.steps}, loss {at.loss:.3f}, "
                f"{at.seconds_left / 60:.1f} min left",
                file=sys.stderr,
                flush=True,
            )

    state = training.train(
        images,
        truth,
        classes=len(labels()),
        epochs=epochs,
        lr=LEARNING_RATE,
        seed=seed,
        progress=say,
    )
    folder = reference.get_data_folder()
    folder.mkdir(exist_ok=True)
    training.save(folder, state, labels())
    logits = calibration.predict(reference.load(folder), held)
    temperature = calibration.fit_temperature(logits, held_truth)
    figures = {
        "pictures": counts["train"],
        "epochs": epochs,
        "seed": seed,
        "temperature": temperature,
    }
    training.save(
        folder, training.with_temperature(state, temperature), labels(), figures
    )


def evaluate(cache: Path, count: int, seed: int) -> None:
    """Measure the stored model on held-out pictures and on the default view of every
    object; keep the figures.
    """
    threads.configure()
    import reference_calibration as calibration
    from reference_scenes import labels

    from advsearch.models import reference

    folder = reference.get_data_folder()
    record = json.loads((folder / reference.METADATA).read_text(encoding="utf-8"))
    images, truth = pictures(cache, "heldout", count, seed)
    report = calibration.evaluate(reference.load(folder), images, truth)
    record["figures"]["heldout"] = _rounded(asdict(report))
    record["figures"]["default_views"] = _rounded(default_views())
    (folder / reference.METADATA).write_text(
        json.dumps(record, indent=1) + "\n", encoding="utf-8"
    )
    print(
        f"held-out pictures: {report.count}, right {report.accuracy:.4f}, "
        f"calibration error {report.error:.4f}"
    )
    for name, accuracy in zip(labels(), report.per_class, strict=True):
        view = record["figures"]["default_views"][name.replace(" ", "-")]
        print(f"  {name:12s} right {accuracy:.3f}   default view {view:.3f}")


def default_views(spp: int = 64) -> dict[str, float]:
    """Return the probability that the reference model gives each bundled object in its
    default view.
    """
    import torch
    from reference_scenes import SIZE

    from advsearch.controls import Space
    from advsearch.models import reference
    from advsearch.questions.harden.objects import HOUSEHOLD
    from advsearch.scene.description import load_description
    from advsearch.scene.formation import ImageFormation
    from advsearch.scene.mitsuba_backend.scene import MitsubaScene
    from advsearch.scene.renderer import Renderer

    model = reference.load()
    found = {}
    for name in sorted(HOUSEHOLD):
        description = load_description(name)
        formation = ImageFormation(resolution=SIZE, gain=description.gain)
        renderer = Renderer(MitsubaScene(description, SIZE), Space(()), formation)
        with torch.no_grad():
            probabilities = model(renderer(torch.zeros(0), seed=0, spp=spp)).softmax(
                dim=-1
            )[0]
        found[name] = float(
            probabilities[model.labels.index(description.object.label or name)]
        )
    return found


def _rounded(value: Any) -> Any:
    """Round every number to 4 digits, so that the record stays short."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(item) for item in value]
    return round(value, 4) if isinstance(value, float) else value


if __name__ == "__main__":
    sys.exit(main())
