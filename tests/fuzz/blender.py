"""Blender files: damaged ones, and a Blender that writes hostile glTF or nothing and says anything."""

from fuzz import gltf
from fuzz.case import Case, Maker, Random
from fuzz.mutations import damaged

HEAD = b"BLENDER-v405" + b"REND" + bytes(60) + b"ENDB"
SAID = (
    b"",
    b"Error: File written by newer Blender\n",
    b"\x1b]0;owned\x07\x1b[31mError\n",
    b"x" * 100_000 + b"\n",
    b"\xff\xfe\x00\n\n \n",
)


def blend(random: Random) -> Case:
    """A Blender file."""
    files = {"room.blend": HEAD, "said": random.choice(SAID)}
    what = "Blender fails"
    kind = random.random()
    if kind < 0.3:
        what, files["room.blend"] = damaged(random, HEAD)
    elif kind < 0.9:
        made = random.choice(gltf.MAKERS)(random)
        what, files["made.glb"] = f"as {made.what}", made.files[made.main]
    return Case(f"blend: {what}", "blend", "room.blend", files)


MAKERS: tuple[Maker, ...] = (blend,)
