"""The pictures of an attack that a run keeps: as the model sees them, and with its answers drawn into them."""

from __future__ import annotations

from torch import Tensor

from advsearch import seeds
from advsearch.engine.problem import Problem
from advsearch.engine.record import KEPT, Findings
from advsearch.report.marks import marked
from advsearch.runs import images
from advsearch.runs.directory import RunDirectory
from advsearch.tasks import Mark


def write_pictures(
    run: RunDirectory,
    problem: Problem,
    findings: Findings,
    linear: dict[str, Tensor],
    seen: dict[str, Tensor],
    u: Tensor,
) -> None:
    """Write the pictures of the clean and the adversarial scene, of their difference, of trials and of the search.

    Args:
        run: gets them.
        problem: that was attacked.
        findings: of the attack.
        linear: (H, W, 3) radiance by "clean" and "adversarial".
        seen: the pictures (H, W, 3) that the model sees, likewise.
        u: (d,) of the adversarial one.
    """
    gain = problem.renderer.formation.gain
    for name, at in (("clean", problem.domain.start), ("adversarial", u)):
        run.save_image(name, seen[name])
        run.save_exr(name, linear[name] * gain)
        save_marked(run, name, seen[name], problem.marks(seen[name], problem.whole(at)))
    run.save_image("difference", images.difference(seen["clean"], seen["adversarial"]))
    checked = findings.verification
    kind = "verification" if findings.beaten is None else "baseline verification"
    for number in range(min(KEPT, len(checked.adversarial_trials) if checked else 0)):
        assert checked is not None
        seed, name = seeds.stream(problem.seed, "verification", number), f"verification-{number:02d}"
        picture = findings.pictures.get((kind, number))
        picture = problem.picture(checked.u, seed, findings.spp) if picture is None else picture
        run.save_image(name, picture)
        save_marked(run, name, picture, problem.marks(picture, problem.whole(checked.u, seed)))
    if findings.frames:
        run.save_animation("search", [*findings.frames, seen["adversarial"].numpy()])


def save_marked(run: RunDirectory, name: str, picture: Tensor, marks: list[Mark]) -> None:
    """Write ``<name>-answer.png``, the picture with marks; nothing where there are none."""
    if marks:
        run.save_image(f"{name}-answer", marked(picture.numpy(), marks))


def write_artifacts(run: RunDirectory, artifacts: dict[str, Tensor]) -> None:
    """Keep what the controls hand over: an 8-bit PNG, and an EXR of the same display-referred values in float32."""
    for name, picture in artifacts.items():
        run.save_image(name, picture, folder="artifacts")
        run.save_exr(name, picture, folder="artifacts")
