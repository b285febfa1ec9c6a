"""The meshes of a place from a glTF file: one for each material, as far as a variant
leaves it one.

Beside what is read of an object's file, materials have the strength of their reflection
(KHR_materials_ior and KHR_materials_specular) and a clear coat, may repeat their
textures, and may be others in a variant (KHR_materials_variants). Where a variant
changes all that has a material, that mesh keeps its name and only looks otherwise;
where it changes a part, the part becomes a mesh named by the other material: snow, on
what faces up.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from advsearch.errors import FileFormatError, InputError, UnknownNameError
from advsearch.pictures import without_pillows_limit
from advsearch.scene.assets import (
    Float32Array,
    Float64Array,
    IntArray,
    Material,
    Mesh,
    compute_area_vectors,
    compute_lengths,
    multiply_rows,
)
from advsearch.scene.importing import gltf_skeleton
from advsearch.scene.importing.files import Notes, UniqueNames, check_faces, damaged
from advsearch.scene.importing.geometry import compute_rotation
from advsearch.scene.importing.gltf import GltfFile
from advsearch.scene.importing.gltf_entries import (
    Entry,
    Header,
    Index,
    MaterialEntry,
    Primitive,
)
from advsearch.scene.importing.gltf_parts import (
    GltfSurfaces,
    PrimitiveData,
    note_skipped_contents,
    read_primitive,
)
from advsearch.scene.importing.parts import (
    NEUTRAL_GREY,
    ImportedPart,
    ImportedSurface,
    transform_part,
)
from advsearch.scene.importing.pictures import LARGEST_SUM
from advsearch.scene.importing.readers import read_mesh_bytes
from advsearch.scene.importing.scenes import RESERVED_NAMES
from advsearch.scene.parts import BASE_COLOR, MeshPart
from advsearch.trust.stored_files import check_most

SUFFIXES = (".glb", ".gltf")
# longest side of a texture; a facade is larger than what an object wears
TEXTURE_LIMIT = 8192
MAX_MESHES = 200
MAX_TEXELS = 2 * LARGEST_SUM
"""Of all materials: a picture that many of them share is small in the file, and a
texture of each in memory.
"""
REFLECTANCE = 0.08  # of a surface of specular 1 that faces the light
DULL_COAT = 0.1  # width of the lobe of Mitsuba's clear coat, of gloss 0 and 1
GLOSSY_COAT = 0.001
VARIANTS = "KHR_materials_variants"
PLACE_EXTENSIONS = (
    "KHR_materials_clearcoat",
    "KHR_materials_ior",
    "KHR_materials_specular",
    VARIANTS,
)
UNNAMED = "mesh"  # what has no material

M = TypeVar("M", bound=BaseModel)
Unit = Annotated[float, Field(ge=0.0, le=1.0)]


class _Extension(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


class _Ior(_Extension):
    ior: Annotated[float, Field(ge=1.0, le=10.0)] = 1.5


class _Specular(_Extension):
    specularFactor: Unit = 1.0


class _Clearcoat(_Extension):
    clearcoatFactor: Unit = 0.0
    clearcoatRoughnessFactor: Unit = 0.0


class _Finish(_Extension):
    """The extensions of a material that are read here."""

    KHR_materials_ior: _Ior = _Ior()
    KHR_materials_specular: _Specular = _Specular()
    KHR_materials_clearcoat: _Clearcoat = _Clearcoat()


class _VariantName(_Extension):
    name: str


class _Variants(_Extension):
    """The variants of a file."""

    variants: list[_VariantName] = []


class _Mapping(_Extension):
    """The material that a primitive has in some variants."""

    material: Index
    variants: list[Index]


class _Mappings(_Extension):
    mappings: list[_Mapping] = []


def _read_extension(path: Path, model: type[M], content: object) -> M:
    """Return an extension of the file as a model; with defaults where it is None.

    Raises FileFormatError: it has other types than the model.
    """
    try:
        return model.model_validate({} if content is None else content)
    except ValidationError as error:
        first_error = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first_error["loc"]))[:80]
        raise damaged(
            path,
            f"extensions as glTF has them ({where}: {first_error['msg'][:100]})",
            "others",
        ) from None


def _get_extension(entry: Entry, name: str) -> object:
    """Return an extension of an entry of the header; None if it has none."""
    return entry.extensions.get(name) if isinstance(entry.extensions, dict) else None


class PosedPrimitive(NamedTuple):
    """A primitive at one of its positions in the file."""

    material: int | None  # index of its original material
    variant_material: int | None  # index of its material in the variant
    part: ImportedPart  # its geometry, without a surface


NameAndMaterial = tuple[str, int | None]


def read_place_meshes(
    path: Path, variant: str | None
) -> tuple[list[MeshPart], list[str]]:
    """Read the meshes of a place, and notes on what is left out.

    Meshes are in metres, z up, and their emission is in cd/m2. Each has one material.

    Args:
        path: the glTF file.
        variant: name of a variant of its materials; None for none.

    Raises:
        FileFormatError: it is missing, damaged, over a limit, or has no faces.
        InputError: its geometry has NaN or infinite numbers, or it has too many
            materials.
        UnknownNameError: it has no such variant.
    """
    notes = Notes(path)
    file = GltfFile(path, read_mesh_bytes(path, "environment", SUFFIXES))
    header = file.header
    variant_index = None if variant is None else _find_variant(path, header, variant)
    with without_pillows_limit(), np.errstate(all="ignore"):
        primitives, surfaces = _read_primitives(file, variant_index, notes)
    # what no import of glTF reads, and what only a place leaves out
    note_skipped_contents(_drop_supported_extensions(header), notes)
    _note_omissions(header, primitives, notes)
    check_faces(path, sum(len(primitive.part.faces) for primitive in primitives))
    groups = _group_by_material(header, primitives)
    if not groups:
        raise FileFormatError(
            f"{path}: expected meshes with faces, got none; export triangles"
        )
    _check_materials(path, len(groups))
    return _make_mesh_parts(path, header, groups, surfaces), list(notes)


def _make_mesh_parts(
    path: Path,
    header: Header,
    groups: Mapping[NameAndMaterial, Sequence[ImportedPart]],
    surfaces: Mapping[int | None, ImportedSurface],
) -> list[MeshPart]:
    """Return a mesh for each group of parts, with the surface of their material.

    Args:
        path: the file, for messages.
        header: header of the file.
        groups: parts by the name of their mesh and the index of their material.
        surfaces: surfaces by the index of the material.
    """
    names = UniqueNames(RESERVED_NAMES)
    parts = list[MeshPart]()
    for (name, material), members in groups.items():
        part = _make_part(path, names.make_unique(name), members, surfaces[material])
        # adds specular and clear coat, which `surfaces` do not have
        parts.append(_with_finish(path, header, material, part))
    return parts


def _drop_supported_extensions(header: Header) -> Header:
    """Return the header without the extensions that only places support."""
    used = [name for name in header.extensionsUsed if name not in PLACE_EXTENSIONS]
    required = [
        name for name in header.extensionsRequired if name not in PLACE_EXTENSIONS
    ]
    return header.model_copy(
        update={"extensionsUsed": used, "extensionsRequired": required}
    )


def _note_omissions(
    header: Header, primitives: Sequence[PosedPrimitive], notes: Notes
) -> None:
    """Note what only a place leaves out: vertex colors, skins and lights.

    Args:
        header: header of the file.
        primitives: the primitives that were read.
        notes: gets the notes.
    """
    if any(primitive.part.colors is not None for primitive in primitives):
        notes.warn(
            " has colours of vertices, which are left out; paint them into a texture"
        )
    if header.skins or header.animations:
        notes.warn(
            " has skins or animations, which are left out: it is shown as it is stored"
        )
    if any(node.lamp is not None for node in header.nodes):
        notes.warn(
            " has lights, which are left out: name what shines in `lamps`, or "
            "let its material emit light"
        )


def _find_variant(path: Path, header: Header, variant: str) -> int:
    """Return the index of a variant; raises UnknownNameError without one such."""
    extension = _read_extension(path, _Variants, _get_extension(header, VARIANTS))
    names = [entry.name for entry in extension.variants]
    if variant not in names:
        raise UnknownNameError(f"variant of {path.name}:", variant, names)
    return names.index(variant)


def _select_material(
    path: Path, header: Header, primitive: Primitive, variant: int | None
) -> int | None:
    """Return the index of the material that a primitive has in a variant.

    It is the primitive's own where the variant does not change it, or is None.
    """
    extension = _get_extension(primitive, VARIANTS)
    if variant is None or extension is None:
        return primitive.material
    for mapping in _read_extension(path, _Mappings, extension).mappings:
        if variant in mapping.variants:
            _check_material_exists(path, header, mapping.material)
            return mapping.material
    return primitive.material


def _check_material_exists(path: Path, header: Header, index: int) -> None:
    """Raise FileFormatError if a file has no material with an index."""
    if index >= len(header.materials):
        expected = f"glTF with {index + 1} materials, as it refers to"
        raise damaged(path, expected, f"{len(header.materials)}")


def _list_posed_meshes(header: Header) -> list[tuple[int, Float64Array]]:
    """Return mesh and pose of each node that has a mesh, in the order of nodes."""
    posed_meshes = []
    posed_nodes = sorted(
        gltf_skeleton.iterate_node_poses(header), key=lambda item: item[0]
    )
    for node, pose in posed_nodes:
        mesh = header.nodes[node].mesh
        if mesh is not None:
            posed_meshes.append((mesh, pose))
    return posed_meshes


def _read_primitives(
    file: GltfFile, variant: int | None, notes: Notes
) -> tuple[list[PosedPrimitive], dict[int | None, ImportedSurface]]:
    """Read the primitives of the meshes at the file's nodes, and their surfaces.

    Several nodes may have the same mesh. It is read once, and the result has it in the
    pose of each node.

    Args:
        file: the glTF file.
        variant: index of a variant of its materials; None for none.
        notes: a note is added on everything that is left out.

    Returns:
        The primitives in the pose of each node, and the surface of each material.
    """
    posed_meshes = _list_posed_meshes(file.header)
    used_meshes = dict.fromkeys(mesh for mesh, _ in posed_meshes)
    pieces = _read_pieces(file, list(used_meshes), variant)
    fitted = _fit_surfaces(file, pieces, notes)
    primitives: list[PosedPrimitive] = []
    for mesh, pose in posed_meshes:
        for index, primitive in enumerate(file.header.meshes[mesh].primitives):
            piece = pieces.get((mesh, index))
            if piece is not None:  # otherwise it is made of points or lines
                _surface, uv_scale, uv_shift = fitted[piece.material_index]
                part = _fit_uvs(piece.part, uv_scale, uv_shift)
                primitives.append(_pose_primitive(primitive, piece, part, pose))
    surfaces = {material: surface for material, (surface, _, _) in fitted.items()}
    return primitives, surfaces


def _pose_primitive(
    primitive: Primitive,
    piece: PrimitiveData,
    part: ImportedPart,
    pose: Float64Array,
) -> PosedPrimitive:
    """Return a primitive in the pose (4, 4) of a node.

    The material of the variant decides about the surface, and the original one about
    the name of the mesh, see `_group_by_material`.

    Args:
        primitive: entry of the primitive, with its original material.
        piece: the same with its material in the variant.
        part: its geometry, with UVs that fit its surface.
        pose: pose of the node.
    """
    return PosedPrimitive(
        primitive.material,
        variant_material=piece.material_index,
        part=transform_part(part, pose),
    )


def _fit_uvs(
    part: ImportedPart, scale: Float64Array, shift: Float64Array
) -> ImportedPart:
    """Return a part with its UVs in the texture of its surface, v = 0 at the bottom.

    Args:
        part: part with the UVs of the file, where v = 0 is at the top.
        scale, shift: (2,) scale and shift from the file's UVs to the texture.
    """
    uvs = part.uvs
    if uvs is None:
        return part
    texture_uvs = uvs * scale + shift
    flipped_uvs = texture_uvs * [1.0, -1.0] + [0.0, 1.0]  # v becomes 1 - v
    return replace(part, uvs=flipped_uvs)


def _read_pieces(
    file: GltfFile, meshes: Sequence[int], variant: int | None
) -> dict[tuple[int, int], PrimitiveData]:
    """Read the primitives of meshes with the materials of a variant.

    Primitives without faces, such as lines, are left out.

    Args:
        file: the glTF file.
        meshes: indices of the meshes.
        variant: index of a variant of the materials; None for none.

    Returns:
        The primitives, by the index of the mesh and that of the primitive in it.
    """
    header = file.header
    pieces: dict[tuple[int, int], PrimitiveData] = {}
    for mesh in meshes:
        for index, primitive in enumerate(header.meshes[mesh].primitives):
            material = _select_material(file.path, header, primitive, variant)
            variant_primitive = primitive.model_copy(update={"material": material})
            piece = read_primitive(
                file,
                variant_primitive,
                mesh_extras=header.meshes[mesh].extras,
                is_skinned=False,  # a place leaves skins out
            )
            if piece is not None and len(piece.part.faces):
                pieces[mesh, index] = piece
    return pieces


def _fit_surfaces(
    file: GltfFile, pieces: Mapping[tuple[int, int], PrimitiveData], notes: Notes
) -> dict[int | None, tuple[ImportedSurface, Float64Array, Float64Array]]:
    """Return the surface of each material, with the scale and shift of its UVs.

    A surface's images are fitted to the texture coordinates of all pieces with its
    material. The piece's UVs times the scale (2,) plus the shift (2,) are its texture
    coordinates in them.

    Args:
        file: the glTF file.
        pieces: geometry by the index of its mesh and of the primitive in it.
        notes: a note is added on everything that is left out.

    Raises FileFormatError, InputError: there are too many materials or texels.
    """
    pieces_by_material = _group_pieces(pieces.values())
    _check_materials(file.path, len(pieces_by_material))
    surfaces = GltfSurfaces(file, notes, TEXTURE_LIMIT)
    fit_by_material: dict[
        int | None, tuple[ImportedSurface, Float64Array, Float64Array]
    ] = {}
    n_texels = 0
    for material, members in pieces_by_material.items():
        fit_by_material[material] = surfaces.make_surface(material, members)
        surface, _uv_scale, _uv_shift = fit_by_material[material]
        n_texels += _count_texels(surface)
        _check_n_texels(file.path, n_texels)
    return fit_by_material


def _check_n_texels(path: Path, n_texels: int) -> None:
    """Raise FileFormatError if the images of all surfaces have too many texels."""
    check_most(
        path,
        n_texels,
        MAX_TEXELS,
        "textures of at most {} texels, counted for each material",
    )


def _group_pieces(
    pieces: Iterable[PrimitiveData],
) -> dict[int | None, list[PrimitiveData]]:
    """Return the primitives of each material, by the material's index."""
    pieces_by_material: dict[int | None, list[PrimitiveData]] = {}
    for piece in pieces:
        pieces_by_material.setdefault(piece.material_index, []).append(piece)
    return pieces_by_material


def _check_materials(path: Path, count: int) -> None:
    """Raise InputError if a file has more than `MAX_MESHES` materials."""
    if count > MAX_MESHES:
        raise InputError(
            f"{path}: expected at most {MAX_MESHES} materials, got {count}; join some "
            "of them"
        )


def _count_texels(surface: ImportedSurface) -> int:
    """Return the texels of all images of a surface."""
    images = (surface.texture, surface.normal_map, surface.emission)
    return sum(
        texels.shape[0] * texels.shape[1] for texels in images if texels is not None
    )


def _group_by_material(
    header: Header, primitives: Sequence[PosedPrimitive]
) -> dict[NameAndMaterial, list[ImportedPart]]:
    """Group primitives to meshes of one material each, in the order of materials.

    A variant may replace the material of each primitive. If all primitives of an
    original material get the same replacement, they become one mesh. It has the name of
    the original material, which is the same in all variants. If they get different
    replacements, there is a mesh for each, with the name of the replacement.

    Args:
        header: header of the file, with the names of materials.
        primitives: the primitives in their poses, with both materials.

    Returns:
        The parts of each mesh, by its name and the index of its material in the
        variant.
    """
    variant_materials = _find_variant_materials(primitives)
    parts_by_mesh: dict[NameAndMaterial, list[ImportedPart]] = {}
    for material, variant_material, part in primitives:
        is_split = len(variant_materials[material]) > 1
        naming_material = variant_material if is_split else material
        name = _name_material(header, naming_material)
        parts_by_mesh.setdefault((name, variant_material), []).append(part)
    sorted_meshes = sorted(parts_by_mesh, key=_get_material_order)
    return {mesh: parts_by_mesh[mesh] for mesh in sorted_meshes}


def _find_variant_materials(
    primitives: Sequence[PosedPrimitive],
) -> dict[int | None, set[int | None]]:
    """Return for each original material those by which the variant replaces it."""
    variant_materials: dict[int | None, set[int | None]] = {}
    for primitive in primitives:
        materials = variant_materials.setdefault(primitive.material, set())
        materials.add(primitive.variant_material)
    return variant_materials


def _get_material_order(mesh: NameAndMaterial) -> int:
    """Return the index of a mesh's material; below all others without one."""
    _, material = mesh
    return -1 if material is None else material


def _name_material(header: Header, index: int | None) -> str:
    """Return the name of a material by its index, or one for a material without."""
    if index is None:
        return UNNAMED
    return header.materials[index].name or f"material {index}"


def _make_part(
    path: Path, name: str, members: Sequence[ImportedPart], surface: ImportedSurface
) -> MeshPart:
    """Return one mesh of a place from its parts and their surface.

    A color without a texture becomes a texture of 2 x 2 texels. A fourth channel of the
    texture, alpha, becomes the opacity.

    Args:
        path: the file, for messages.
        name: name of the mesh.
        members: the primitives that it is joined from.
        surface: their material, as the file has it.

    Raises InputError: the joined geometry cannot be used.
    """
    texture = _make_texture(surface)
    opacity = None
    if texture.shape[-1] == 4:
        opacity = np.ascontiguousarray(texture[..., 3])
    try:
        mesh = _join(members)
    except InputError as error:  # its message does not name the file
        raise InputError(f"{path}: {name}: {error}") from None
    return MeshPart(
        name=name,
        mesh=mesh,
        base_color=np.ascontiguousarray(texture[..., :3]),
        # takes the numbers of `surface`, whose fields have the names of a material's
        material=Material().with_values(vars(surface), ""),
        opacity=opacity,
        normal_map=surface.normal_map,
        emission=surface.emission,
    )


def _make_texture(surface: ImportedSurface) -> Float32Array:
    """Return the texture (H, W, 3 or 4) of a surface, or 2 x 2 texels of its color."""
    if surface.texture is not None:
        return surface.texture
    color = surface.color
    if color is None:
        color = np.full(3, NEUTRAL_GREY, np.float32)
    return np.broadcast_to(color, (2, 2, len(color)))


def _with_finish(
    path: Path, header: Header, index: int | None, part: MeshPart
) -> MeshPart:
    """Return a mesh with the specular and the clear coat of its material.

    In the file these are extensions of the material. The gloss of a coat needs a
    surface in Mitsuba's own description, which a mesh with an opacity or a normal map
    cannot have. The coat of such a mesh has Mitsuba's default gloss.

    Args:
        path: the file, for messages.
        header: header of the file.
        index: index of the material; None: the mesh has none.
        part: the mesh.
    """
    entry = MaterialEntry() if index is None else header.materials[index]
    finish = _read_extension(path, _Finish, entry.extensions)
    specular = _compute_specular(finish)
    coat = finish.KHR_materials_clearcoat
    material = replace(part.material, specular=specular, clearcoat=coat.clearcoatFactor)
    part = replace(part, material=material)
    is_plain = part.opacity is None and part.normal_map is None
    if coat.clearcoatFactor == 0.0 or not is_plain:
        return part
    surface = _make_coated_surface(material, coat.clearcoatRoughnessFactor)
    return replace(part, surface=surface)


def _compute_specular(finish: _Finish) -> float:
    """Return the specular of a material, from its index of refraction and its factor.

    The fraction that is reflected of light along the normal is ((n - 1) / (n + 1))^2
    for an index of refraction n (Fresnel). A specular of 1 here reflects `REFLECTANCE`.
    """
    ior = finish.KHR_materials_ior.ior
    facing_reflectance = (
        finish.KHR_materials_specular.specularFactor * ((ior - 1.0) / (ior + 1.0)) ** 2
    )
    # Rounded, so that glTF's default of 1.5 gives exactly the value of our default.
    return min(round(facing_reflectance / REFLECTANCE, 9), 1.0)


def _make_coated_surface(material: Material, coat_roughness: float) -> dict[str, Any]:
    """Return Mitsuba's description of a surface with a clear coat, by its roughness.

    The width of the coat's lobe is the square of glTF's roughness; Mitsuba's goes from
    `DULL_COAT` at a gloss of 0 to `GLOSSY_COAT` at 1.
    """
    gloss = (DULL_COAT - coat_roughness**2) / (DULL_COAT - GLOSSY_COAT)
    principled = {
        "type": "principled",
        "base_color": {"type": BASE_COLOR, "filter_type": "bilinear"},
        # roughness and so on, by Mitsuba's names
        **vars(material),
        "clearcoat_gloss": min(max(gloss, 0.0), 1.0),
    }
    return {"type": "twosided", "bsdf": principled}


def _join(members: Sequence[ImportedPart]) -> Mesh:
    """Join parts of a file to one mesh, z up, its front along +x.

    The parts have glTF's axes: y up, the front along +z. Missing texture coordinates
    become 0, and missing normals those of the faces. All normals become unit vectors.
    """
    rotation = compute_rotation("y", "+z")  # from glTF's axes
    parts = [_with_normals(part) for part in members]
    vertices = np.concatenate([part.vertices for part in parts])
    directions = np.concatenate(
        [part.normals for part in parts if part.normals is not None]  # all have some
    )
    directions /= np.maximum(compute_lengths(directions), 1e-12)
    return Mesh(
        multiply_rows(vertices, rotation.T).astype(np.float32),
        _join_faces(parts).astype(np.uint32),
        multiply_rows(directions, rotation.T).astype(np.float32),
        np.concatenate([_get_uvs(part) for part in parts]).astype(np.float32),
    )


def _join_faces(parts: Sequence[ImportedPart]) -> IntArray:
    """Return the faces (F, 3) of all parts, as indices of all their vertices."""
    faces = list[IntArray]()
    n_vertices = 0
    for part in parts:
        faces.append(part.faces + n_vertices)
        n_vertices += len(part.vertices)
    return np.concatenate(faces)


def _get_uvs(part: ImportedPart) -> Float64Array:
    """Return the texture coordinates (V, 2) of a part; 0 if it has none."""
    return np.zeros((len(part.vertices), 2)) if part.uvs is None else part.uvs


def _with_normals(part: ImportedPart) -> ImportedPart:
    """Return a part with the normals of its faces where it has none.

    Then every face has vertices of its own. Normals are not of unit length yet.
    """
    if part.normals is not None:
        return part
    corners = part.vertices[part.faces]
    normals = np.repeat(compute_area_vectors(corners), 3, axis=0)
    uvs = None if part.uvs is None else part.uvs[part.faces].reshape(-1, 2)
    faces = np.arange(len(normals)).reshape(-1, 3)
    return replace(
        part, vertices=corners.reshape(-1, 3), faces=faces, normals=normals, uvs=uvs
    )
