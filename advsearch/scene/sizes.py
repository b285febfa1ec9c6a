"""How large things really are: an object's longest side in metres, from what is said of it or from its file.

A scene is as large as its object is 1. `ObjectAsset.metres` is the one number that makes metres of it: whatever speaks
of metres (distances of the camera, the road, what stands beside the object) divides by `SceneDescription.metres`.
"""

from __future__ import annotations

import re
from dataclasses import replace

from advsearch.described import rounded
from advsearch.errors import InputError
from advsearch.scene.assets import ObjectAsset

UNITS = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254}  # metres of the units that a mesh may be in
TRIPOD = 1.6  # metres above the floor from which photographed environments are taken, where nobody says it
SMALLEST, LARGEST = 1e-4, 1e4  # metres of an object's longest side
USUAL = {
    "airplane": (6.0, 75.0), "apple": (0.05, 0.12), "backpack": (0.3, 0.8), "ball": (0.03, 0.4),
    "banana": (0.12, 0.3), "bed": (1.6, 2.4), "bench": (1.0, 2.5), "bicycle": (1.3, 2.0), "bike": (1.3, 2.3),
    "boat": (2.0, 40.0), "book": (0.12, 0.4), "bottle": (0.1, 0.4), "bowl": (0.08, 0.4), "bus": (6.0, 20.0),
    "car": (2.5, 6.0), "cat": (0.25, 0.8), "chair": (0.6, 1.4), "cow": (1.5, 3.0), "cup": (0.05, 0.2),
    "dog": (0.3, 1.4), "hammer": (0.15, 0.6), "horse": (1.6, 3.0), "hydrant": (0.5, 1.2), "keyboard": (0.2, 0.5),
    "lamp": (0.2, 2.2), "laptop": (0.25, 0.5), "man": (1.4, 2.1), "motorcycle": (1.6, 2.7), "mug": (0.07, 0.2),
    "pan": (0.25, 0.6), "person": (0.8, 2.1), "phone": (0.1, 0.2), "pickup": (4.0, 7.0), "sedan": (3.8, 5.5),
    "shoe": (0.15, 0.4), "sign": (0.5, 4.0), "sofa": (1.3, 3.5), "suv": (3.8, 5.6), "table": (0.5, 3.0),
    "teapot": (0.12, 0.4), "tractor": (2.5, 8.0), "train": (15.0, 400.0), "truck": (4.5, 20.0), "van": (3.8, 7.5),
    "vase": (0.1, 0.9), "vehicle": (2.0, 20.0), "woman": (1.3, 2.0),
}  # fmt: skip
"""Metres that the longest side of a thing lies between, by the word for it in the name of a file: wide, to tell one
unit from another."""
ROAD_VEHICLES = frozenset("bicycle bike bus car lorry motorcycle pickup sedan suv tractor truck van vehicle".split())
"""Words for what is seen from the height of other road users, in the name or the label of an object."""


def on_roads(asset: ObjectAsset) -> bool:
    """Tell whether an object is a vehicle of the road whose size is known."""
    words = re.split(r"[^a-z]+", f"{asset.name} {asset.label or ''}".lower())
    return asset.metres is not None and not ROAD_VEHICLES.isdisjoint(words)


def sized(asset: ObjectAsset, size: float | None, unit: str | None) -> ObjectAsset:
    """Return an object with its size in metres, where it is told: by `size`, of its longest side in metres, by `unit`,
    one of `UNITS`, of its file, or by itself. Raises InputError: both are given, `size` is out of range, or the object
    comes from no file that could have a unit."""
    if size is None and unit is None:
        return asset
    if size is not None and unit is not None:
        raise InputError("size and unit: both say how large the object is; leave one of them out")
    if unit is not None and unit not in UNITS:
        raise InputError(f"unit: expected one of {', '.join(UNITS)}, got {unit!r}")
    if unit is not None and asset.extent is None:
        raise InputError(f"unit: {asset.name} is no mesh file; give its longest side in metres, such as size=0.1")
    metres = float(size) if size is not None else (asset.extent or 0.0) * UNITS[unit or "m"]
    if not SMALLEST <= metres <= LARGEST:
        said = f"size={size:g}" if size is not None else f"unit={unit} for a mesh of {asset.extent:.4g}"
        raise InputError(
            f"{said}: expected a longest side of {SMALLEST:g} to {LARGEST:g} metres, got {metres:.4g}; give it in "
            "metres, such as size=4.9"
        )
    return replace(asset, metres=metres)


def doubts(asset: ObjectAsset, *, asked: bool, laid: bool) -> tuple[str, ...]:
    """Return what is said where an object's size is unlike that of a thing of its name, or is not known: `asked` tells
    that its user gave its size, `laid` that something in the scene has one in metres, such as the road."""
    kind = next((word for word in reversed(re.split(r"[^a-z]+", asset.name.lower())) if word in USUAL), None)
    low, high = (0.005, 100.0) if kind is None else USUAL[kind]
    strange = asset.metres is not None and not low <= asset.metres <= high
    missing = asset.metres is None and (laid or (kind is not None and asset.extent is not None))
    if asked or not (strange or missing):
        return ()
    extent = 0.0 if asset.extent is None or kind is None else asset.extent
    fits = [unit for unit, metres in UNITS.items() if low <= extent * metres <= high]
    what = [
        f"its longest side is {rounded(asset.metres or 0.0)} m" if strange else "its size in metres is not known",
        f"it is {rounded(extent)} in its file" if missing and extent else "",
        f"a {kind}'s is {low:g} to {high:g} m" if kind else "",
        "it is taken for 1 m, as the road is in metres" if missing and laid else "",
    ]
    give = f"give its longest side in metres, such as `size={(low * high) ** 0.5:.2g}`"
    if fits:
        give += f", or `unit={fits[0]}`, which makes it {rounded(extent * UNITS[fits[0]])} m"
    return (f"{asset.name}: {'; '.join(filter(None, what))}. {'If that is wrong, g' if strange else 'G'}{give[1:]}",)
