"""Which parts of an object's surface, when seen, go with wrong predictions
(docs/sweeps.md, "The surface"): the interval of a difference is Newcombe's (1998,
Statistics in Medicine 17, method 10) of Wilson's (1927); what is chance comes from
sharing the wrong predictions out anew, each time with the part that stands out most
(Westfall and Young 1993, the single-step maximum) by the likelihood ratio. Where
pictures share a draw (frames of a drive), draws are exchanged whole, and no interval is
told.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from math import ceil
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from scipy.special import xlogy

from advsearch import seeds
from advsearch.attacks.domain import batches
from advsearch.engine.loading import framed, load_scene
from advsearch.engine.record import judgement_of
from advsearch.options import OUT_OF_VIEW
from advsearch.progress import Progress
from advsearch.questions.sweep.job import OpenScenes
from advsearch.questions.sweep.result import rate
from advsearch.questions.sweep.summary import SurfaceMap, SurfacePart, SurfaceTable
from advsearch.report.figures import drawn
from advsearch.report.wording import short_name
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row
from advsearch.scene.assets import ObjectAsset
from advsearch.scene.description import OBJECT
from advsearch.scene.formation import Surfaces
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.surface_parts import CELLS, SurfaceParts
from advsearch.statistics.intervals import wilson
from advsearch.trust.writing import write_bytes

Counts = npt.NDArray[np.int64]
Doubles = npt.NDArray[np.float64]
# how often the wrong predictions are shared out anew, so that no p-value is under 0.005
SHARINGS = 199
# where no part has to do with the predictions, the chance that any is told from chance
LEVEL = 0.05


class PartCounts:
    """Counts of n parts over so many pictures, of which some are `failures`: those that
    show each (`seen`), and of these the failures (`wrong`), both (n,); `chance`
    (SHARINGS, n) is the same for failures that are shared out: each by itself, or as
    `exchanged` says, bits of (SHARINGS, pictures) packed along the first axis.
    """

    def __init__(
        self,
        parts: int,
        pictures: int,
        failures: int,
        seed: int,
        exchanged: npt.NDArray[np.uint8] | None = None,
    ) -> None:
        self.exchanged = exchanged
        self.pictures = pictures
        self.failures = failures
        self.seen, self.wrong = np.zeros((2, parts), np.int64)
        self.chance = np.zeros((SHARINGS, parts), np.uint32)
        self._left, self._to_go = pictures, np.full(SHARINGS, failures)
        self._random = np.random.default_rng(seed)

    def add(self, parts: Counts, failed: bool) -> None:
        """Count a picture, by the numbers of the parts that hold in it, each once."""
        self.seen[parts] += 1
        self.wrong[parts] += failed
        if self.exchanged is not None:
            drawn = np.unpackbits(
                self.exchanged[:, self.pictures - self._left], count=SHARINGS
            ).astype(bool)
        else:  # so that each choice of pictures is equally likely
            drawn = self._random.random(SHARINGS) * self._left < self._to_go
        self._left = self._left - 1
        self._to_go = self._to_go - drawn
        self.chance[np.ix_(np.flatnonzero(drawn), parts)] += 1


def association(tally: PartCounts, some: slice, least: int) -> pd.DataFrame:
    """Compare the predictions where each of some parts holds with those where it does
    not; at least so many pictures of either kind.

    Of each part, by its number, NaN where it was not `compared`: the `difference` of
    the share of wrong predictions where it holds less that where it does not, both ends
    of the 95 % interval (`low`, `high`) for the part by itself, and how likely it is
    that by chance any part stands out as far (`p`); whether it is `told` from chance;
    and as its `strength` the end of the interval that is nearer to 0, without its sign;
    0 where the interval contains 0. Without an interval that is how large the
    difference is.
    """
    seen = tally.seen[some]
    wrong = tally.wrong[some]
    pictures = tally.pictures
    failures = tally.failures
    compared = (seen >= least) & (pictures - seen >= least)
    columns = dict.fromkeys(("difference", "low", "high", "p"), np.nan)
    parts = pd.DataFrame(columns, index=np.arange(len(tally.seen))[some]).assign(
        compared=compared
    )
    if compared.any():
        n = seen[compared]
        k = wrong[compared]
        difference, low, high = _newcombe(k, n, failures - k, pictures - n)
        if tally.exchanged is not None:
            low = high = np.full(len(n), np.nan)
        dealt = (shared[some][compared].astype(np.int64) for shared in tally.chance)
        most = np.sort(
            [_likelihood_ratio(wrongs, n, failures, pictures).max() for wrongs in dealt]
        )
        above = len(most) - np.searchsorted(
            most, _likelihood_ratio(k, n, failures, pictures) - 1e-9
        )
        parts.loc[compared, list(columns)] = np.stack(
            [difference, low, high, (1 + above) / (1 + len(most))], axis=1
        )
    nearer = np.where(
        parts.low.isna(), parts.difference.abs(), np.maximum(parts.low, -parts.high)
    )
    return parts.assign(
        told=parts.p <= LEVEL, strength=np.nan_to_num(np.maximum(nearer, 0.0))
    )


def _likelihood_ratio(k: Counts, n: Counts, failures: int, pictures: int) -> Doubles:
    """Twice the log of how much likelier k of n, and the rest of the failures beside
    them, are with shares of their own than with one share: 0 or more.
    """
    counts = (k, n - k, failures - k, pictures - n - failures + k)
    sums = (n, pictures - n, np.array(failures), np.array(pictures - failures))
    told = (
        xlogy(pictures, pictures)
        + sum(xlogy(one, one) for one in counts)
        - sum(xlogy(one, one) for one in sums)
    )
    return np.asarray(2.0 * told)


def _newcombe(
    k: Counts, n: Counts, others: Counts, rest: Counts
) -> tuple[Doubles, Doubles, Doubles]:
    one = k / n
    two = others / rest
    (below, above) = wilson(one, n)
    (under, over) = wilson(two, rest)
    difference = one - two
    low = difference - np.hypot(one - below, over - two)
    high = difference + np.hypot(above - one, two - under)
    return difference, low, high


# pictures that have to see a part, and as many that do not, before its predictions are
# compared
LEAST = 5
RAYS = 4 * CELLS
"""Least number of rays along each side of a picture: in smaller ones, many cells would
lie between two pixels.
"""
STRONGEST = 5
"""Parts of each kind that the summary lists: so many that go with wrong predictions,
and so many with right ones.
"""
# distance of two listed parts, in units of the object's largest extent, so that one
# spot is listed once
APART = 0.1
FILE = "artifacts/surface.npz"
SIDES = (
    (0.0, 20.0),
    (90.0, 20.0),
    (180.0, 20.0),
    (270.0, 20.0),
    (0.0, 80.0),
    (0.0, -60.0),
)
"""Azimuth and elevation of the cameras that show the object in colours, degrees."""
SIDE_PIXELS = 240
# stands for the prediction of a picture of which there is no row, or that has nothing
# of the object
UNKNOWN = -1
AT_ONCE = 16  # pictures whose places are worked out at once


class SurfaceCounts:
    """How often each part of an object's surface was seen, and how often the
    predictions of each model were wrong then.
    """

    def __init__(self, parts: SurfaceParts, tallies: Sequence[PartCounts]) -> None:
        self.parts = parts
        self.tallies = tuple(tallies)

    def add(self, shown: Surfaces, wrong: Mapping[int, bool]) -> None:
        """Count a picture, by what it shows and the models whose predictions are
        wrong.
        """
        there = shown.seen(OBJECT)
        face = shown.face[there].numpy()
        uv = shown.uv[there].numpy().astype(np.float64)
        seen = np.unique(self.parts.cells(face, uv))
        if self.parts.by_face:
            seen = np.concatenate([seen, np.unique(face) + CELLS * CELLS])
        for model, failed in wrong.items():
            self.tallies[model].add(seen, failed)

    def table(
        self,
        name: str,
        model: str,
        tally: PartCounts,
        kind: str,
        compared: pd.DataFrame,
    ) -> SurfaceTable:
        """Return what a model's predictions have to do with the parts of a kind. Listed
        are those that are told from chance most clearly, none close to another: those
        that go with wrong predictions, and then with right ones.
        """
        extent = float(np.ptp(self.parts.mesh.vertices, axis=0).max())
        strongest = list[SurfacePart]()
        for side in (compared.difference > 0.0, compared.difference < 0.0):
            listed: list[int] = []
            for part in (
                compared[compared.told & side]
                .sort_values("strength", ascending=False, kind="stable")
                .index
            ):
                away = np.linalg.norm(
                    self.parts.place[listed] - self.parts.place[part], axis=1
                )
                if away.min(initial=np.inf) >= APART * extent:
                    listed.append(int(part))
                if len(listed) == STRONGEST:
                    break
            for part in listed:
                seen = int(tally.seen[part])
                wrong = int(tally.wrong[part])
                hidden = tally.pictures - seen
                others = tally.failures - wrong
                u, v = self.parts.at[part].tolist()
                strongest.append(
                    SurfacePart(
                        face=int(self.parts.face[part]),
                        u=u,
                        v=v,
                        place=self.parts.place[part].tolist(),
                        seen=rate(seen - wrong, seen),
                        hidden=rate(hidden - others, hidden),
                        difference=float(compared.difference[part]),
                        interval=(
                            float(compared.low[part]),
                            float(compared.high[part]),
                        ),
                        p=float(compared.p[part]),
                    )
                )
        return SurfaceTable(
            object=name,
            model=model,
            part=kind,
            unwrapped=self.parts.unwrapped,
            seen=int((tally.seen[self.parts.kinds[kind]] > 0).sum()),
            compared=int(compared.compared.sum()),
            worse=int((compared.told & (compared.difference > 0)).sum()),
            better=int((compared.told & (compared.difference < 0)).sum()),
            strongest=strongest,
        )


def map_surface(
    scenes: OpenScenes, rows: Iterable[Row], run: RunDirectory, progress: Progress
) -> SurfaceMap:
    """Count over the surface of each object, write the counts and their figure, and
    return what the summary says.
    """
    job = scenes.job
    points = scenes.open(0).points[scenes.job.sizes[0]]
    per_scene = points.count
    models = len(job.models)
    wrong: npt.NDArray[np.int8] = np.full(
        (len(job.places), per_scene, models), UNKNOWN, np.int8
    )
    for row in rows:
        # nor is it hidden in a picture that has nothing of the object
        if row.label != OUT_OF_VIEW:
            wrong.flat[row.step] = not judgement_of(row).right
    draws = np.asarray(points.units.draw(np.arange(wrong[..., 0].size))).reshape(
        wrong.shape[:2]
    )
    assets = {place.object: place.scene.description.object for place in job.places}
    counts = dict[str, SurfaceCounts]()
    for number, (name, asset) in enumerate(assets.items()):
        parts = SurfaceParts(asset.mesh)
        tallies = list[PartCounts]()
        here = [place.object == name for place in job.places]
        for model in range(models):
            seed = seeds.stream(job.config.seed, "surface", number * models + model)
            own = wrong[here][..., model]
            exchanged = exchange(own.ravel(), draws[here].ravel(), seed)
            tallies.append(
                PartCounts(
                    parts.count,
                    int((own >= 0).sum()),
                    int((own >= 1).sum()),
                    seed,
                    exchanged,
                )
            )
        counts[name] = SurfaceCounts(parts, tallies)
    for scene, pictures in enumerate(wrong):
        view = scenes.open(scene)
        mine = counts[job.places[scene].object]
        for some in batches(0, per_scene, AT_ONCE):
            for size in dict.fromkeys(job.sizes):
                asked = [model for model in range(models) if job.sizes[model] == size]
                us = view.points[size].configurations(
                    some.start, len(some), scene * per_scene
                )
                fineness = ceil(RAYS / min(size))
                seen = (view.renderers[size].surfaces(u, fineness) for u in us)
                for said, shown in zip(
                    pictures[some.start : some.stop], seen, strict=True
                ):
                    mine.add(
                        shown,
                        {
                            model: bool(said[model])
                            for model in asked
                            if said[model] != UNKNOWN
                        },
                    )
            progress.advance(len(some) * models)
    return _written(counts, assets, [model.name for model in job.models], run)


def exchange(
    wrong: npt.NDArray[np.int8], draws: Counts, seed: int
) -> npt.NDArray[np.uint8] | None:
    """Return the predictions of whole draws dealt out to draws anew, as `PartCounts`
    takes them; None where each picture has a draw of its own. Both (n,), predictions
    that are not known are left out.
    """
    known = wrong != UNKNOWN
    (_, of) = np.unique(draws, return_counts=True)
    if of.max(initial=1) == 1:
        return None
    # each has as many pictures
    order = np.argsort(draws, kind="stable").reshape(len(of), -1)
    generator = np.random.default_rng(seed)
    found = np.zeros((SHARINGS, len(wrong)), bool)
    for one in found:
        one[order] = (wrong == 1)[order[generator.permutation(len(order))]]
    return np.packbits(found[:, known], axis=0)


def _written(
    counts: Mapping[str, SurfaceCounts],
    assets: Mapping[str, ObjectAsset],
    models: Sequence[str],
    run: RunDirectory,
) -> SurfaceMap:
    tables = []
    panels = []
    arrays: dict[str, Any] = {
        "objects": np.array(list(counts)),
        "models": np.array(models),
    }
    for number, (name, mine) in enumerate(counts.items()):
        parts = mine.parts
        views = tuple(_views(assets[name], mine.parts))
        compared = [
            {
                kind: association(tally, some, LEAST)
                for kind, some in parts.kinds.items()
            }
            for tally in mine.tallies
        ]
        for what in ("pictures", "failures", "seen", "wrong"):
            arrays[f"{what}_{number}"] = np.stack(
                [getattr(tally, what) for tally in mine.tallies]
            )
        for what in ("difference", "low", "high", "p"):
            joined = [
                np.concatenate([frame[what] for frame in kinds.values()])
                for kinds in compared
            ]
            arrays[f"{what}_{number}"] = np.stack(joined).astype(np.float32)
        arrays[f"map_{number}"] = parts.corners.astype(np.float32)
        for model, tally, kinds in zip(models, mine.tallies, compared, strict=True):
            cells = kinds["cell"]
            there = parts.covered.ravel() | (tally.seen[parts.kinds["cell"]] > 0)
            colours = np.where(cells.compared.to_numpy()[:, None], UNTOLD, UNCOMPARED)
            colours = np.where(there[:, None], colours, NOTHING)
            title = f"{short_name(name)}, {short_name(model)}"
            panels.append(
                Panel(
                    title, colours, cells.difference.where(cells.told).to_numpy(), views
                )
            )
            tables += [
                mine.table(name, model, tally, kind, frame)
                for kind, frame in kinds.items()
            ]
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    write_bytes(run.path / FILE, stream.getvalue())
    panels = panels[:MOST_PANELS]
    for suffix, data in drawn(
        partial(_draw, panels), (10.0, 0.5 + 3.6 * len(panels)), kinds=("png",)
    ).items():
        write_bytes(run.path / "images" / f"surface.{suffix}", data)
    return SurfaceMap(file=FILE, cells=CELLS, least=LEAST, tables=tables)


MOST_PANELS = 12  # objects times models that are drawn; the file of the counts has all
# the direction that the object is shaded from, world space; of length 1
LIGHT = (0.36, 0.48, 0.80)
COLOURS = "PuOr_r"
"""ColorBrewer's purple to orange, which people see apart who see no red or no green:
orange is wrong more often.
"""
UNTOLD = (0.78, 0.78, 0.78)
UNCOMPARED = (0.45, 0.45, 0.45)
NOTHING = (1.0, 1.0, 1.0)
"""Grey where a part is not told from chance, darker where too few pictures show it or
do not; white beside charts.
"""
ROWS = 2  # rows of the views of an object


class MapView(NamedTuple):
    """What a camera sees of an object: where it stands, as text; the number of the cell
    in each pixel (H, W), row by row of the map, -1 beside the object; and how bright
    that is (H, W).
    """

    title: str
    cells: Counts
    shade: Doubles


class Panel(NamedTuple):
    """What is drawn of one object and one model: the colours (cells, 3) of what is not
    told from chance, and by how much predictions are wrong more often where a cell is
    seen, NaN where that is not told, (cells,).
    """

    title: str
    colours: Doubles
    difference: Doubles
    views: tuple[MapView, ...]


def _views(asset: ObjectAsset, parts: SurfaceParts) -> Iterator[MapView]:
    alone = framed(
        load_scene(asset, settings={"ground.size": 0.0}).description, SIDE_PIXELS
    )
    scene = MitsubaScene(alone, (SIDE_PIXELS, SIDE_PIXELS))
    for azimuth, elevation in SIDES:
        camera = camera_to_world(
            alone.with_values(camera__azimuth=azimuth, camera__elevation=elevation), 1.0
        )
        shown = scene.surfaces(
            {"camera.to_world": torch.from_numpy(camera.astype(np.float32))}
        )
        there = shown.seen(OBJECT).numpy()
        cells = np.full(there.shape, -1, np.int64)
        cells[there] = parts.cells(
            shown.face.numpy()[there], shown.uv.numpy()[there].astype(np.float64)
        )
        shade = 0.7 + 0.3 * np.clip(shown.normal.numpy() @ np.array(LIGHT), 0.0, 1.0)
        yield MapView(f"{azimuth:g}°, {elevation:g}° up", cells, shade)


def _draw(panels: Sequence[Panel], figure: Any) -> None:
    """Draw a row for each panel, at one scale: the map, and the object in its colours
    from some sides.
    """
    import matplotlib as mpl  # takes long to import

    largest = max(
        (float(np.nanmax(np.abs(one.difference), initial=0.0)) for one in panels),
        default=0.0,
    )
    end = max(ceil(10.0 * largest - 1e-9) / 10.0, 0.1)
    scale = mpl.cm.ScalarMappable(
        mpl.colors.Normalize(-end, end), mpl.colormaps[COLOURS]
    )
    axes = figure.subplots(len(panels), 2, squeeze=False, width_ratios=(1.0, 1.55))
    for (flat, solid), (title, greys, difference, views) in zip(
        axes, panels, strict=True
    ):
        colours = np.where(
            np.isnan(difference)[:, None], greys, scale.to_rgba(difference)[:, :3]
        )
        flat.imshow(
            colours.reshape(CELLS, CELLS, 3),
            extent=(0, 1, 0, 1),
            interpolation="nearest",
        )
        flat.set(xlabel="u", ylabel="v")
        flat.set_title(title)
        solid.axis("off")
        across = ceil(len(views) / ROWS)
        # white beside the object
        mosaic = np.ones((ROWS * SIDE_PIXELS, across * SIDE_PIXELS, 3))
        for number, (side, cells, shade) in enumerate(views):
            row, column = (SIDE_PIXELS * at for at in divmod(number, across))
            worn = np.where(
                cells[..., None] >= 0,
                colours[np.maximum(cells, 0)] * shade[..., None],
                1.0,
            )
            mosaic[row : row + SIDE_PIXELS, column : column + SIDE_PIXELS] = worn
            solid.text(
                column + 0.5 * SIDE_PIXELS,
                row + 4,
                side,
                ha="center",
                va="top",
                fontsize=7,
            )
        solid.imshow(mosaic)

    def percent(value: float, _: object) -> str:
        return f"{100.0 * value:+.3g} %" if value else "0 %"

    bar = figure.colorbar(
        scale, ax=axes, shrink=0.8 if len(panels) == 1 else 0.4, format=percent
    )
    bar.set_label(
        "share of wrong predictions where it is seen,\nless that where it is not"
    )
    texts = {
        UNTOLD: "not told from chance",
        UNCOMPARED: "too few pictures with or without it",
    }
    marks = [
        mpl.patches.Patch(facecolor=colour, label=text)
        for colour, text in texts.items()
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=2)
