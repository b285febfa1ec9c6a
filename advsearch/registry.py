"""Registries: things of one kind by their word on the command line, our own and those of other packages.

A package adds to a registry through an entry point of the registry's group, as `docs/extending.md` shows.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Generic, TypeVar

from advsearch.errors import InputError

Entry = TypeVar("Entry")


class Registry(Mapping[str, Entry], Generic[Entry]):
    """Entries by name: our own first, in the order given, then those of installed packages; ours win a name.

    Args:
        group: of entry points: "advsearch.policies".
        own: our entries; one given as text, "module:attribute", is imported when it is asked for.
        expected: what an entry is, for messages: "a subclass of Policy whose name is that of the entry point".
        fits: whether an object under a name is one.
        imports: whether the name "package.module:Class", of something that nobody has registered, is one too: a class
            with a capital letter, from the Python path or the current directory.
    """

    def __init__(
        self,
        group: str,
        own: Mapping[str, Entry | str],
        expected: str,
        fits: Callable[[str, Any], bool],
        *,
        imports: bool = False,
    ) -> None:
        self.group = group
        self._own, self._expected, self._fits, self._imports = own, expected, fits, imports

    def __getitem__(self, name: str) -> Entry:
        if self.names_class(name):
            return self._class(name)
        if name not in self._own:
            return self._installed[name]
        entry = self._own[name]
        if isinstance(entry, str):
            module, _, attribute = entry.partition(":")
            imported: Entry = getattr(import_module(module), attribute)
            return imported
        return entry

    def __iter__(self) -> Iterator[str]:
        return iter([*self._own, *(name for name in self._installed if name not in self._own)])

    def __len__(self) -> int:
        return len(list(iter(self)))

    def names_class(self, name: str) -> bool:
        """Whether a name is that of a class to import, and not of an instance of a registered entry ("light:Key")."""
        module, colon, attribute = name.partition(":")
        if not (self._imports and colon and attribute[:1].isupper() and attribute.isidentifier()):
            return False
        parts = module.split(".")
        return all(part.isidentifier() for part in parts) and not (parts[0] in self._own or parts[0] in self._installed)

    def _class(self, name: str) -> Entry:
        """Import "package.module:Class".

        Raises:
            InputError: it cannot be imported, or is something else.
        """
        module, _, attribute = name.partition(":")
        try:
            with current_directory_importable():
                entry: Entry = getattr(import_module(module), attribute)
        except Exception as error:  # the user's code may raise anything
            mend = f"a module is looked for on the Python path and in {os.getcwd()}"
            raise InputError(f"{name}: cannot be imported ({type(error).__name__}: {error}); {mend}") from error
        if not self._fits(getattr(entry, "kind", ""), entry):
            raise InputError(f"{name}: expected {self._expected}, got {entry!r}")
        return entry

    @cached_property
    def _installed(self) -> dict[str, Entry]:
        """Entries of other packages.

        Raises:
            InputError: what an entry point names cannot be imported, or is something else.
        """
        found: dict[str, Entry] = {}
        for point in entry_points(group=self.group):
            where = f"entry point {point.name} = {point.value} of group {self.group}"
            mend = "repair or uninstall the package that declares it"
            try:
                entry = point.load()
            except (ImportError, AttributeError) as error:
                raise InputError(f"{where}: cannot be imported ({error}); {mend}") from None
            if not self._fits(point.name, entry):
                raise InputError(f"{where}: expected {self._expected}; {mend}")
            found[point.name] = entry
        return found


@contextmanager
def current_directory_importable() -> Iterator[None]:
    """Look for modules in the current directory too, behind the rest of the path, inside the block."""
    directory = os.getcwd()
    added = directory not in sys.path and "" not in sys.path
    if added:
        sys.path.append(directory)
        importlib.invalidate_caches()
    try:
        yield
    finally:
        if added and directory in sys.path:
            sys.path.remove(directory)
