"""Files of objects that are not read: what they are comes first, then what to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from advsearch.errors import FileFormatError
from advsearch.scene.importing.objects import import_object


@pytest.mark.parametrize(
    ("ending", "what", "do"),
    [
        (".splat", "Gaussian splats", "fuse_post.ply"), (".fbx", "an FBX model", "bpy.ops.import_scene.fbx"),
        (".DAE", "a COLLADA model", "assimp export 'my thing.DAE' 'my thing.obj'"),
    ],
)  # fmt: skip
def test_it_says_what_the_file_is_and_then_what_to_do(ending: str, what: str, do: str, tmp_path: Path) -> None:
    path = tmp_path / f"my thing{ending}"
    path.write_bytes(b"anything")
    with pytest.raises(FileFormatError) as caught:
        import_object(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert message.index(what) < message.index(do)
