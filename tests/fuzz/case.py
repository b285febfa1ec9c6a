"""What one case of the fuzz is: a few files made from a seed, and the loader that has to survive them."""

import os
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

OUTSIDE = b"@OUTSIDE@"
"""Stands in a file's content for the absolute path of the folder that nothing may be read from."""

Random = random.Random


@dataclass(frozen=True)
class Case:
    """Files for one loader.

    Attributes:
        what: the format and what was done to it, for reports: ``"obj: truncated"``.
        loader: a key of `LOADERS` in `fuzz.loading`.
        main: the file that the loader is given, relative to the case's folder.
        files: content by relative path; `OUTSIDE` in it is replaced.
        links: symbolic links by relative path; targets are relative to the link.
        pipes: relative paths of named pipes.
    """

    what: str
    loader: str
    main: str
    files: Mapping[str, bytes]
    links: Mapping[str, str] = field(default_factory=dict)
    pipes: tuple[str, ...] = ()

    def write(self, folder: Path, outside: Path) -> Path:
        """Write the files into a new folder and return the path of the main one."""
        for name, content in self.files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content.replace(OUTSIDE, os.fsencode(outside)))
        for name, target in self.links.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).symlink_to(target)
        for name in self.pipes:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            os.mkfifo(folder / name)
        return folder / self.main


Maker = Callable[[Random], Case]
"""Makes one case; everything that varies comes from the generator it is given."""
