"""Registries: things of one kind by their word on the command line, our own and those of other packages.

A package adds to a registry through an entry point of the registry's group, as `docs/extending.md` shows.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
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
        """Import "package.module:Class". Raises InputError where it cannot be imported, is something else, or must not
        be imported (`only_named_code`)."""
        module, _, attribute = name.partition(":")
        check_import(name)
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
        """Entries of other packages. Raises InputError where what an entry point names cannot be imported, or is
        something else."""
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


_GUARD: ContextVar[tuple[str, frozenset[str]] | None] = ContextVar("guard", default=None)
"""The file whose settings are carried out, and the code that may be imported for it; None for no such file."""


@contextmanager
def only_named_code(file: str | os.PathLike[str], named: Iterable[str]) -> Iterator[None]:
    """Import no Python code by its name inside the block but what is named: the settings are somebody's file.

    Args:
        file: for messages.
        named: "package.module:attribute", each as it stands in the file.
    """
    token = _GUARD.set((os.fspath(file), frozenset(named)))
    try:
        yield
    finally:
        _GUARD.reset(token)


def check_import(name: str) -> None:
    """Check that "package.module:attribute" may be imported.

    Raises:
        InputError: a file names it, and nobody else.
    """
    guard = _GUARD.get()
    if guard is None or name in guard[1]:
        return
    package = name.partition(":")[0].partition(".")[0]
    with current_directory_importable():
        try:
            found = importlib.util.find_spec(package)
        except (ImportError, ValueError):
            found = None
    where = f" from {found.origin}" if found is not None and found.origin else ""
    raise InputError(
        f"{guard[0]}: names {name}, Python code{where} that would be imported and run; read it, and if you trust it, "
        f"name it yourself with `code={name}`"
    )


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
