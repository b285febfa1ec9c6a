"""Which parts of an object's surface, when seen, go with wrong answers (docs/sweeps.md, "The surface").

It comes from the rows of a sweep that has ended and from what each of its pictures sees first, without noise: another
pass over the same rows says the same, whether the sweep was stopped on the way or not.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import ceil
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from advsearch import seeds
from advsearch.attacks.draws import batches
from advsearch.engine.loading import framed, load_scene
from advsearch.engine.rows import judgement_of
from advsearch.engine.sweeps.association import Association, PartCounts, association
from advsearch.engine.sweeps.job import Job
from advsearch.engine.sweeps.summary import rate
from advsearch.engine.sweeps.swept_scene import SweptScene
from advsearch.progress import Progress
from advsearch.report.surface import SurfacePanel, SurfaceView, surface_figure
from advsearch.runs.directory import RunDirectory
from advsearch.runs.files import write_bytes
from advsearch.runs.results.sweep import SurfaceMap, SurfacePart, SurfaceTable
from advsearch.runs.store import Row
from advsearch.scene.assets import ObjectAsset
from advsearch.scene.description import OBJECT
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.surface_parts import CELLS, SurfaceParts
from advsearch.scene.surfaces import Surfaces

LEAST = 5
"""Pictures that have to see a part, and as many that do not, before its answers are compared."""

RAYS = 4 * CELLS
"""Least number of rays along each side of a picture: in smaller ones, many cells would lie between two pixels."""

STRONGEST = 5
"""Parts of each kind that the summary lists: so many that go with wrong answers, and so many with right ones."""

APART = 0.1
"""Distance of two listed parts, in units of the object's largest extent, so that one spot is listed once."""

FILE = "artifacts/surface.npz"
"""Where the counts are kept in the folder of a run."""

SIDES = ((0.0, 20.0), (90.0, 20.0), (180.0, 20.0), (270.0, 20.0), (0.0, 80.0), (0.0, -60.0))
"""Azimuth and elevation of the cameras that show the object in colours, degrees."""

SIDE_PIXELS = 240
"""Width and height of these pictures."""

UNKNOWN = -1
"""Stands for the answer to a picture of which there is no row."""

AT_ONCE = 16
"""Pictures whose places are worked out at once."""


class SurfaceCounts:
    """How often each part of an object's surface was seen, and how often the answers were wrong then.

    Args:
        parts: of the object.
        tallies: for each model, of as many parts.
    """

    def __init__(self, parts: SurfaceParts, tallies: Sequence[PartCounts]) -> None:
        self.parts, self.tallies = parts, tuple(tallies)

    def add(self, shown: Surfaces, wrong: Mapping[int, bool]) -> None:
        """Count a picture.

        Args:
            shown: what it shows.
            wrong: by the number of the model, whether its answer is wrong.
        """
        there = shown.seen(OBJECT)
        face, uv = shown.face[there].numpy(), shown.uv[there].numpy().astype(np.float64)
        seen = np.unique(self.parts.cells(face, uv))
        if self.parts.by_face:
            seen = np.concatenate([seen, np.unique(face) + CELLS * CELLS])
        for model, failed in wrong.items():
            self.tallies[model].add(seen, failed)

    def compared(self, model: int) -> dict[str, Association]:
        """Return what a model's answers have to do with each part that is seen, by the kind of part."""
        return {kind: association(self.tallies[model], some, LEAST) for kind, some in self.parts.kinds.items()}

    def table(self, name: str, model: str, tally: PartCounts, kind: str, found: Association) -> SurfaceTable:
        """Return what the summary says of one kind of part."""
        some = self.parts.kinds[kind]
        return SurfaceTable(
            object=name,
            model=model,
            part=kind,
            unwrapped=self.parts.unwrapped,
            seen=int((tally.seen[some] > 0).sum()),
            compared=int(found.compared.sum()),
            worse=int((found.told & (found.difference > 0)).sum()),
            better=int((found.told & (found.difference < 0)).sum()),
            strongest=[self._part(some.start + one, one, tally, found) for one in self._strongest(some.start, found)],
        )

    def _strongest(self, first: int, found: Association) -> list[int]:
        """The parts that are told from chance most clearly, none close to another: those that go with wrong answers,
        and then those that go with right ones."""
        extent = float(np.ptp(self.parts.mesh.vertices, axis=0).max())
        order = np.argsort(-found.strength, kind="stable")
        listed: list[int] = []
        for side in (found.difference > 0.0, found.difference < 0.0):
            mine: list[int] = []
            for number in order[(found.told & side)[order]]:
                places = self.parts.place[[first + one for one in mine]]
                away = np.linalg.norm(places - self.parts.place[first + number], axis=1)
                if away.min(initial=np.inf) >= APART * extent:
                    mine.append(int(number))
                if len(mine) == STRONGEST:
                    break
            listed += mine
        return listed

    def _part(self, part: int, number: int, tally: PartCounts, found: Association) -> SurfacePart:
        seen, wrong = int(tally.seen[part]), int(tally.wrong[part])
        hidden, others = tally.pictures - seen, tally.failures - wrong
        x, y, z = self.parts.place[part].tolist()
        u, v = self.parts.at[part].tolist()
        return SurfacePart(
            face=int(self.parts.face[part]),
            u=u,
            v=v,
            place=(x, y, z),
            seen=rate(seen - wrong, seen),
            hidden=rate(hidden - others, hidden),
            difference=float(found.difference[number]),
            interval=(float(found.low[number]), float(found.high[number])),
            p=float(found.p[number]),
        )


def map_surface(
    job: Job, rows: Iterable[Row], opened: Callable[[int], SweptScene], run: RunDirectory, progress: Progress
) -> SurfaceMap:
    """Count over the surface of each object, write the counts and their figure, and return what the summary says.

    Args:
        job: what was swept.
        rows: all that it has stored, in whatever order.
        opened: gives a scene by its number.
        run: gets the files.
        progress: told of each row.
    """
    per_scene, models = opened(0).points[job.sizes[0]].count, len(job.models)
    wrong: npt.NDArray[np.int8] = np.full((len(job.places), per_scene, models), UNKNOWN, np.int8)
    for row in rows:
        wrong.flat[row.step] = not judgement_of(row).right
    counts = _empty(job, wrong)
    for scene, answers in enumerate(wrong):
        view, mine = opened(scene), counts[job.places[scene].object]
        for some in batches(0, per_scene, AT_ONCE):
            for size in dict.fromkeys(job.sizes):
                asked = [model for model in range(models) if job.sizes[model] == size]
                picks = view.points[size].picks(some.start, len(some), scene * per_scene)
                seen = view.surfaces(picks, size, ceil(RAYS / min(size)))
                for said, shown in zip(answers[some.start : some.stop], seen, strict=True):
                    mine.add(shown, {model: bool(said[model]) for model in asked if said[model] != UNKNOWN})
            progress.advance(len(some) * models)
    return _told(job, counts, run)


def _empty(job: Job, wrong: npt.NDArray[np.int8]) -> dict[str, SurfaceCounts]:
    """Counts of each object, by its name, that know how many answers (scenes, pictures, models) there will be."""
    counts, models = {}, len(job.models)
    for number, (name, asset) in enumerate(_assets(job).items()):
        parts, tallies = SurfaceParts(asset.mesh), []
        mine = wrong[[place.object == name for place in job.places]]
        for model in range(models):
            seed = seeds.stream(job.config.seed, "surface", number * models + model)
            answers, failures = (int((mine[..., model] >= least).sum()) for least in (0, 1))
            tallies.append(PartCounts(parts.count, answers, failures, seed))
        counts[name] = SurfaceCounts(parts, tallies)
    return counts


def _assets(job: Job) -> dict[str, ObjectAsset]:
    return {place.object: place.scene.description.object for place in job.places}


def _told(job: Job, counts: Mapping[str, SurfaceCounts], run: RunDirectory) -> SurfaceMap:
    """Compare, write the files, and return the tables."""
    assets, models = _assets(job), [model.name for model in job.models]
    tables, panels = [], []
    arrays: dict[str, Any] = {"objects": np.array(list(counts)), "models": np.array(models)}
    for number, (name, mine) in enumerate(counts.items()):
        views = _views(assets[name], mine.parts)
        found = [mine.compared(model) for model in range(len(models))]
        for what in ("pictures", "failures", "seen", "wrong"):
            arrays[f"{what}_{number}"] = np.stack([getattr(one, what) for one in mine.tallies])
        for what in ("difference", "low", "high", "p"):
            joined = [np.concatenate([getattr(one, what) for one in kinds.values()]) for kinds in found]
            arrays[f"{what}_{number}"] = np.stack(joined).astype(np.float32)
        arrays[f"map_{number}"] = mine.parts.corners.astype(np.float32)
        for model, tally, kinds in zip(models, mine.tallies, found, strict=True):
            panels.append(_panel(name, model, mine.parts, tally, kinds["cell"], views))
            tables += [mine.table(name, model, tally, kind, one) for kind, one in kinds.items()]
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    write_bytes(run.path / FILE, stream.getvalue())
    for suffix, data in surface_figure(panels).items():
        write_bytes(run.path / "images" / f"surface.{suffix}", data)
    return SurfaceMap(file=FILE, cells=CELLS, least=LEAST, tables=tables)


def _panel(
    name: str, model: str, parts: SurfaceParts, tally: PartCounts, found: Association, views: Sequence[SurfaceView]
) -> SurfacePanel:
    square = (CELLS, CELLS)
    return SurfacePanel(
        object=name,
        model=model,
        surface=parts.covered | (tally.seen[parts.kinds["cell"]] > 0).reshape(square),
        compared=found.compared.reshape(square),
        difference=np.where(found.told, found.difference, np.nan).reshape(square),
        views=tuple(views),
    )


def _views(asset: ObjectAsset, parts: SurfaceParts) -> list[SurfaceView]:
    """What cameras from some sides see of the object alone."""
    alone = framed(load_scene(asset, settings={"ground.size": 0.0}).description, SIDE_PIXELS)
    scene, views = MitsubaScene(alone, (SIDE_PIXELS, SIDE_PIXELS)), []
    for azimuth, elevation in SIDES:
        camera = camera_to_world(alone.with_values(camera__azimuth=azimuth, camera__elevation=elevation), 1.0)
        shown = scene.surfaces({"camera.to_world": torch.from_numpy(camera.astype(np.float32))})
        there = shown.seen(OBJECT).numpy()
        cells = np.full(there.shape, -1, np.int64)
        cells[there] = parts.cells(shown.face.numpy()[there], shown.uv.numpy()[there].astype(np.float64))
        views.append(SurfaceView(f"{azimuth:g}°, {elevation:g}° up", cells, shown.normal.numpy()))
    return views
