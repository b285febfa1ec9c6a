"""Which rows of a sweep share a draw."""

import json
from dataclasses import asdict
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from advsearch.errors import FileFormatError
from advsearch.runs.store import NAME as STORE
from advsearch.runs.store import Store
from advsearch.runs.tables import UNITS_NOTE, Units, read_units


@pytest.mark.parametrize("frames", [0, 1, 2])
@pytest.mark.parametrize(("models", "again"), [(1, 0), (2, 0), (2, 1)])
def test_rows_of_a_unit_differ_in_frame_model_and_prediction_alone(frames: int, models: int, again: int) -> None:
    sizes, samples, scenes = (3, 2, 4), 2, 2
    whole = Units(sizes, frames, samples, models, again * scenes * 24 * samples)
    found: dict[int, set[tuple[int, ...]]] = {}
    digits = product(range(1 + again), range(scenes), *map(range, sizes), range(samples), range(models))
    for step, (_, scene, *places, sample, _) in enumerate(digits):
        places[frames] = 0
        found.setdefault(whole.find_unit(step), set()).add((scene, *places, sample))
    assert all(len(one) == 1 for one in found.values()), "a unit has one place beside its frames"
    assert len(found) == scenes * 24 // sizes[frames] * samples == len({min(one) for one in found.values()})
    steps = np.arange(scenes * 24 * samples * models * (1 + again))
    assert (whole.find_unit(steps) == [whole.find_unit(int(one)) for one in steps]).all()
    assert (np.unique(whole.find_unit(steps), return_counts=True)[1] == whole.size).all() and whole.name == "drive"


@pytest.mark.parametrize("frames", [None, 1])
def test_pictures_that_differ_in_noise_alone_are_one_unit(frames: int | None) -> None:
    units = Units((3, 5), frames, models=2, noise=4)
    count = 3 if frames == 1 else 15
    steps = np.arange(2 * 15 * 4)
    assert (np.unique(units.find_unit(steps), return_counts=True)[1] == units.size).all()
    assert len(np.unique(units.find_unit(steps))) == count
    assert units.name == ("configuration" if frames is None else "drive")


def test_a_run_notes_its_units_and_what_is_none_is_refused(tmp_path: Path) -> None:
    with Store(tmp_path / STORE) as store:
        assert read_units(store) is None
        store.write_note(UNITS_NOTE, json.dumps(asdict(Units((3, 5), 1, 2, 2, 60))))
        assert read_units(store) == Units((3, 5), 1, 2, 2, 60)
        huge = {"sizes": [10**30]}, {"sizes": [1 << 40] * 4}, {"again": 10**30}, {"sizes": [1] * 5000}
        none = ("[]", '{"sizes": 3}', '{"sizes": [3], "models": 0}', '{"sizes": ["a"]}')
        for text in (*none, *map(json.dumps, huge), json.dumps({"sizes": [9], "samples": 1 << 61})):
            store.write_note(UNITS_NOTE, text)
            with pytest.raises(FileFormatError, match="the units of a sweep"):
                read_units(store)


@pytest.mark.parametrize("again", [0, 1])
def test_pictures_in_one_photograph_are_one_unit(again: int) -> None:
    # two objects in three photographs, five draws each, two models
    units = Units((), samples=5, models=2, again=again * 30, photographs=3, scene=5)
    digits = product(range(1 + again), range(2), range(3), range(5), range(2))
    assert [units.find_unit(step) for step in range(60 * (1 + again))] == [
        photograph for *_, photograph, _, _ in digits
    ]
    assert units.name == "photograph" and units.find_draw(7) == 7, "draws are as ever"
