"""Mitsuba's XML: damaged bytes, hostile texts, planted files and libraries, numbers out of range."""

from fuzz.case import OUTSIDE, Case, Maker, Random
from fuzz.mutations import NUMBERS, damaged

BOX = b"""<scene version="3.0.0"><default name="side" value="0.4"/>
<sensor type="perspective" id="front"><float name="fov" value="40"/>
<transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform></sensor>
<bsdf type="diffuse" id="white"><rgb name="reflectance" value="0.8, 0.7, 0.6"/></bsdf>
<emitter type="constant"><rgb name="radiance" value="1"/></emitter>
<shape type="cube" id="object-1"><transform name="to_world"><scale value="$side"/></transform><ref id="white"/></shape>
<shape type="ply" id="other"><string name="filename" value="mesh.ply"/></shape>
<shape type="sphere"><float name="radius" value="0.2"/><bsdf type="plastic"/></shape></scene>"""
PLY = b"""ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""
LAUGHS = b"".join(b'<default name="v%d" value="%b"/>' % (n, b"$v%d" % (n - 1) * 10) for n in range(1, 12))
TEXTS = {
    "entities": b'<!DOCTYPE s [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]><scene version="3.0.0">&b;</scene>',
    "external entity": b'<!DOCTYPE s [<!ENTITY a SYSTEM "@OUTSIDE@/secret.txt">]><scene version="3.0.0">&a;</scene>',
    "laughs": b'<scene version="3.0.0"><default name="v0" value="ha"/>' + LAUGHS + b"</scene>",
    "deep": b'<scene version="3.0.0">' + b'<bsdf type="twosided">' * 100_000,
    "wide": b'<scene version="3.0.0">' + b'<bsdf type="null"/>' * 300_000 + b"</scene>",
    "itself": b'<scene version="3.0.0"><include filename="box.xml"/><include filename="box.xml"/></scene>',
    "encoding": b'<?xml version="1.0" encoding="utf-99"?><scene version="3.0.0"/>',
    "no text": b"\xff\xfe\x00\x00",
    "empty scene": b'<scene version="3.0.0"/>',
}
INSERTED = (
    b'<shape type="ply"><string name="filename" value="' + OUTSIDE + b'/secret.txt"/></shape>',
    b'<shape type="serialized"><string name="filename" value="mesh.ply"/></shape>',
    b'<include filename="' + OUTSIDE + b'/secret.txt"/>',
    b'<include filename="link.xml"/>',
    b'<bsdf type="planted"/>',
    b'<bsdf type="../../planted"/>',
    b'<bsdf type="conductor"><string name="material" value="../../planted"/></bsdf>',
    b'<texture type="bitmap"><string name="filename" value="mesh.ply"/></texture>',
    b'<emitter type="envmap"><string name="filename" value="/dev/zero"/></emitter>',
    b'<shape type="sdfgrid"/>',
    b'<shape type="instance"/>',
    b'<bsdf type="twosided"/>',
    b'<ref id="nobody"/>',
    b'<texture type="bitmap"/>',
    b'<medium type="homogeneous"/>',
    b'<shape type="cylinder" id="0"><float name="radius" value="0"/></shape>',
    b'<shape type="sphere" id="0"><string name="radius" value="wide"/></shape>',
    b'<sensor type="perspective"><rgb name="fov" value="1"/></sensor>',
    b'<shape type="cube" id="' + b"n" * 3_000 + b'"/>',
    b'<shape type="sphere" id="same"/>' * 40_000,
)


def bytes_damaged(random: Random) -> Case:
    """A scene, or the mesh that it names, with damaged bytes."""
    if random.random() < 0.3:
        what, data = damaged(random, PLY)
        return _case(f"mesh {what}", BOX, {"mesh.ply": data})
    what, data = damaged(random, BOX)
    return _case(what, data)


def texts(random: Random) -> Case:
    """XML that is hostile as text."""
    what = random.choice(sorted(TEXTS))
    return _case(what, TEXTS[what])


def planted(random: Random) -> Case:
    """Plugins and files that must not be taken, and plugins that lack what they need."""
    inserted = random.choice(INSERTED)
    library = {"planted.so": b"\x7fELF", "plugins/planted.so": b"\x7fELF"}
    return _case("planted", BOX.replace(b"</scene>", inserted + b"</scene>"), library)


def numbers(random: Random) -> Case:
    """A number out of range in place of one."""
    at = random.choice((b"40", b"0.4", b"0, 0, 4", b"0.8, 0.7, 0.6", b"0.2"))
    return _case("numbers", BOX.replace(b'"' + at + b'"', b'"' + random.choice(NUMBERS) + b'"', 1))


def _case(what: str, scene: bytes, extra: dict[str, bytes] | None = None) -> Case:
    files = {"box.xml": scene, "mesh.ply": PLY, **(extra or {})}
    return Case(f"mitsuba: {what}", "mitsuba", "box.xml", files, {"link.xml": "../outside/secret.txt"})


MAKERS: tuple[Maker, ...] = (bytes_damaged, texts, planted, numbers)
