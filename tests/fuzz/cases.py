"""All cases of the fuzz: number k of a seed is always the same files."""

import random

from fuzz import blender, gltf, meshes, mitsuba_scenes, models, pictures, rigs, run_folders, runs
from fuzz.case import Case, Maker

MAKERS: tuple[Maker, ...] = (
    *(*meshes.MAKERS, *gltf.MAKERS, *blender.MAKERS, *mitsuba_scenes.MAKERS),
    *(*pictures.MAKERS, *models.MAKERS, *rigs.MAKERS, *runs.MAKERS, *run_folders.MAKERS),
)
"""They take turns, so that any few dozen cases in a row have some of everything."""


def make(seed: int, number: int) -> Case:
    """Return a case."""
    return MAKERS[number % len(MAKERS)](random.Random(f"{seed}/{number}"))
