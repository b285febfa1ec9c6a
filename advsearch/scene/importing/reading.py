"""Building blocks of readers of mesh files and converters to glTF: parts, glTF, messages,
limits, external programs.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from advsearch.pictures import FORMATS as FORMATS
from advsearch.pictures import check_decodable as check_decodable
from advsearch.scene.assets import compute_area_vectors as compute_area_vectors
from advsearch.scene.glb import DEFAULT_SPECULAR as DEFAULT_SPECULAR
from advsearch.scene.glb import GlbBuffer as GlbBuffer
from advsearch.scene.glb import encode_glb as encode_glb
from advsearch.scene.glb import find_mime_type as find_mime_type
from advsearch.scene.importing.files import SPLATS_ADVICE as SPLATS_ADVICE
from advsearch.scene.importing.files import Notes as Notes
from advsearch.scene.importing.files import check_faces as check_faces
from advsearch.scene.importing.files import damaged as damaged
from advsearch.scene.importing.files import describe_content as describe_content
from advsearch.scene.importing.files import format_name as format_name
from advsearch.scene.importing.files import get_last_line as get_last_line
from advsearch.scene.importing.files import is_number as is_number
from advsearch.scene.importing.files import read_bytes as read_bytes
from advsearch.scene.importing.geometry import triangulate as triangulate
from advsearch.scene.importing.parts import ImportedPart as ImportedPart
from advsearch.scene.importing.parts import has_normals as has_normals
from advsearch.scene.importing.unread import TrackedKeys as TrackedKeys
from advsearch.scene.importing.unread import join_names as join_names
from advsearch.trust.code import SUBPROCESS_DIRECTORY as SUBPROCESS_DIRECTORY
from advsearch.trust.named_files import MISSING as MISSING
from advsearch.trust.named_files import OUTSIDE as OUTSIDE
from advsearch.trust.named_files import is_inside as is_inside
from advsearch.trust.programs import find_blender as find_blender
from advsearch.trust.programs import make_environment as make_environment
from advsearch.trust.programs import run_converter as run_converter

if TYPE_CHECKING:
    from advsearch.scene import backdrop as backdrop
    from advsearch.scene.importing import gltf_entries as gltf_entries
    from advsearch.scene.importing import hdr as hdr
    from advsearch.scene.importing import pictures as pictures
    from advsearch.scene.importing.gltf import DEEPEST_TREE as DEEPEST_TREE
    from advsearch.scene.importing.gltf import LARGEST_TREE as LARGEST_TREE

_LATE = {"DEEPEST_TREE": "gltf", "LARGEST_TREE": "gltf"}
_LATE_MODULES = {
    "backdrop": "advsearch.scene.backdrop",
    "gltf_entries": "advsearch.scene.importing.gltf_entries",
    "hdr": "advsearch.scene.importing.hdr",
    "pictures": "advsearch.scene.importing.pictures",
}
"""Modules that few readers need, and that import pydantic, scipy, torch or OpenEXR."""


def __getattr__(name: str) -> Any:
    """Import a name on first use (PEP 562)."""
    if name in _LATE_MODULES:
        return import_module(_LATE_MODULES[name])
    if name in _LATE:
        return getattr(import_module(f"advsearch.scene.importing.{_LATE[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
