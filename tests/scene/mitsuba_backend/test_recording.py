"""Nothing is freed while Dr.Jit records: in 1.5.0 that ends the process."""

import gc
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest

from advsearch.scene.mitsuba_backend.variant import import_mitsuba, record_on_first_use

COLLECTED_IN_A_RECORDING = """
import gc, weakref
import torch
from advsearch.scene.description import load_description
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import import_mitsuba

import_mitsuba()
import drjit

freeze, seen = drjit.freeze, []

def greedy_freeze(function, **options):
    def greedy(*arguments):
        gc.set_threshold(1)  # from here on the collector comes with every other object, if it is on
        image = function(*arguments)
        gc.set_threshold(10**9)
        seen.append(gone() is not None)
        return image
    return freeze(greedy, **options)

gc.set_threshold(10**9)
dropped, other = (MitsubaScene(load_description("mug", "studio"), (8, 8)) for _ in range(2))
for scene in (dropped, other):
    scene.render_radiance({"object.vertices": scene.get_base_value("object.vertices") + 0.1}, seed=1, spp=1)
gone = weakref.ref(dropped)
dropped.itself = dropped
del dropped, scene
drjit.freeze = greedy_freeze
before = other.render_radiance({}, seed=2, spp=4)
assert seen == [True] and gc.isenabled(), "it is there while another is recorded"
gc.collect()
assert gone() is None, "and goes after"
assert torch.equal(other.render_radiance({}, seed=2, spp=4), before)
"""
"""A scene is held by nothing but a cycle when another one is recorded."""


@pytest.mark.medium
def test_a_scene_in_a_cycle_is_not_collected_while_another_is_recorded() -> None:
    done = subprocess.run(
        [sys.executable, "-c", COLLECTED_IN_A_RECORDING], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("on", [gc.enable, gc.disable])
def test_the_collector_is_as_it_was_after_a_recording_and_an_error_in_one(on: Callable[[], None]) -> None:
    mi = import_mitsuba()
    import drjit as dr

    wrong, states = [True], list[bool]()

    def halves(value: Any) -> Any:
        states.append(gc.isenabled())
        if wrong.pop():
            raise KeyboardInterrupt
        return value / 2

    function = record_on_first_use(halves, [])
    before = gc.isenabled()
    try:
        on()
        expected = gc.isenabled()
        with pytest.raises(RuntimeError, match="frozen function"):
            function(dr.opaque(mi.Float, 1.0, 4))
        assert gc.isenabled() == expected
        wrong.append(False)
        assert function(dr.opaque(mi.Float, 3.0, 4)).torch().tolist() == [1.5] * 4
        assert gc.isenabled() == expected
        assert states == [False, False]
    finally:
        (gc.enable if before else gc.disable)()
