"""The one mechanism by which keys of files that nobody read are named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from advsearch.scene.glb import GlbBuffer
from advsearch.scene.importing.objects import import_object
from advsearch.scene.importing.unread import TrackedKeys


def test_what_is_not_read_is_listed_as_it_is_spelled() -> None:
    keys = TrackedKeys({"Fl-X": 1.0, "k7": 0.1, "zero": 0, "none": None, "roi": {"x": 1, "y": 2}}, fold=str.lower)
    assert keys.get("f", "fl-x") == 1.0 and keys.get("none") is None and keys.peek("k7") == 0.1
    assert keys.get_nested("roi").get("x") == 1
    assert keys.get_nested("gone").get("x") is None
    assert keys.find_unread() == ["k7", "zero", "roi.y"]
    assert keys.find_unread(lambda key, value: value == 0) == ["k7", "roi.y"]
    keys.mark_read("k7")
    assert keys.find_unread() == ["zero", "roi.y"]


def test_of_several_names_for_a_thing_the_first_is_read() -> None:
    keys = TrackedKeys({"K": 1, "camera_matrix": 2, "k": 3}, fold=str.lower)
    assert keys.repeated == ["K"] and keys.get("camera_matrix", "k") == 2
    assert keys.find_unread() == ["k"]
    assert "k" in keys and len(keys) == 2 and keys.get_spelling("k") == "k"


def test_keys_inside_of_extensions_that_are_read_are_named(tmp_path: Path) -> None:
    buffer = GlbBuffer()
    points = buffer.add_accessor(np.eye(3, dtype=np.float32), "VEC3", bounds=True)
    strength = {"emissiveStrength": 2.0, "emissiveUnit": "nit"}
    material = {"emissiveFactor": [1, 1, 1], "extensions": {"KHR_materials_emissive_strength": strength}}
    header = {
        "asset": {"version": "2.0"},
        "materials": [material],
        "meshes": [{"primitives": [{"attributes": {"POSITION": points}, "material": 0}]}],
        "nodes": [{"mesh": 0}],
    }
    (tmp_path / "a.glb").write_bytes(buffer.to_bytes(json.loads(json.dumps(header))))
    text = " ".join(import_object(tmp_path / "a.glb").warnings)
    assert "'extensions.KHR_materials_emissive_strength.emissiveUnit' is left out" in text
    assert "emissiveStrength'" not in text
