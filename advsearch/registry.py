"""Registries: things of one kind by their word on the command line, our own and those
of other packages.

A package adds to a registry through an entry point of the registry's group, as
`docs/extending.md` shows.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from advsearch.catalog import BuiltIn, list_built_ins
from advsearch.errors import InputError, UnknownNameError
from advsearch.trust.code import check_import, current_directory_importable

Entry = TypeVar("Entry")


@dataclass(eq=False, repr=False)
class Registry(Mapping[str, Entry], Generic[Entry]):
    """Entries by name: our own first, in the order given, then those of installed
    packages; ours win. An entry is imported when it is asked for, so that a package
    which can't be imported disturbs no other.
    """

    group: str  # of entry points: "advsearch.policies"
    # our entries; one of the catalog is imported when it is asked for
    own: Mapping[str, Entry | BuiltIn]
    # what an entry is, for messages: "a subclass of Policy whose name is that of the
    # entry point"
    expected: str
    fits: Callable[[str, Any], bool]  # whether an object under a name is one
    # whether the name "package.module:Class", of something that nobody has registered,
    # is one too: a class with a capital letter, from the Python path or the current
    # directory
    imports: bool = False

    def __getitem__(self, name: str) -> Entry:
        """Return an entry. Raises InputError where the class that a name is cannot be
        imported, is something else, or must not be imported (`check_import`).
        """
        if not self.names_class(name):
            if name not in self.own:
                return self._load(name)
            own = self.own[name]
            entry: Entry = imported(own.target) if isinstance(own, BuiltIn) else own
            return entry
        check_import(name)
        try:
            with current_directory_importable():
                entry = imported(name)
        except Exception as error:  # the user's code may raise anything
            mend = f"a module is looked for on the Python path and in {os.getcwd()}"
            raise InputError(
                f"{name}: cannot be imported ({type(error).__name__}: {error}); {mend}"
            ) from error
        if not self.fits(getattr(entry, "kind", ""), entry):
            raise InputError(f"{name}: expected {self.expected}, got {entry!r}")
        return entry

    def __contains__(self, name: object) -> bool:
        """Return whether there is an entry, which is imported only where the name is
        that of a class.
        """
        if not isinstance(name, str):
            return False
        if self.names_class(name):
            return self[name] is not None
        return name in self.own or name in self._installed

    def __iter__(self) -> Iterator[str]:
        return iter(
            [*self.own, *(name for name in self._installed if name not in self.own)]
        )

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def get_help(self, name: str) -> str:
        """Return what an entry is, in a sentence: of the catalog, or of another one the
        docstring's first line; of one that can't be imported, why.
        """
        own = self.own.get(name)
        if isinstance(own, BuiltIn):
            return f"{own.help[0].upper()}{own.help[1:]}."
        try:
            return get_first_doc_line(self[name])
        except InputError as error:
            return f"{error}."

    def list_usable(self) -> dict[str, Entry]:
        """Return all entries but those of packages that can't be imported."""
        usable = dict[str, Entry]()
        for name in self:
            with suppress(InputError):
                usable[name] = self[name]
        return usable

    def names_class(self, name: str) -> bool:
        """Whether a name is that of a class to import, and not of an instance of a
        registered entry ("light:Key").
        """
        module, colon, attribute = name.partition(":")
        if not (
            self.imports
            and colon
            and attribute[:1].isupper()
            and attribute.isidentifier()
        ):
            return False
        parts = module.split(".")
        return all(part.isidentifier() for part in parts) and not (
            parts[0] in self.own or parts[0] in self._installed
        )

    @cached_property
    def _installed(self) -> dict[str, EntryPoint]:
        return {point.name: point for point in entry_points(group=self.group)}

    def _load(self, name: str) -> Entry:
        """Import what an entry point names. Raises InputError: it can't be imported, or
        is something else.
        """
        point = self._installed[name]
        where = f"entry point {name} = {point.value} of group {self.group}"
        mend = "repair or uninstall the package that declares it"
        try:
            entry: Entry = point.load()
        except Exception as error:  # another package's code may raise anything
            raise InputError(f"{where}: cannot be imported ({error}); {mend}") from None
        if not self.fits(name, entry):
            raise InputError(f"{where}: expected {self.expected}; {mend}")
        return entry


def get_first_doc_line(entry: Any) -> str:
    """Return the first line of what an object says of itself; empty for plain
    values.
    """
    documented = (
        entry if inspect.isroutine(entry) or inspect.isclass(entry) else type(entry)
    )
    if documented.__module__ == "builtins":
        return str(entry) if isinstance(entry, str) else ""
    return (inspect.getdoc(documented) or "").partition("\n")[0]


def imported(place: str) -> Any:
    """Return what "module:attribute" names."""
    module, _, attribute = place.partition(":")
    return getattr(import_module(module), attribute)


def get_class(kind: str, name: str) -> Any:
    """Return the class of a built-in part by its own name, which is imported. Raises
    AttributeError: there is none.
    """
    for part in list_built_ins(kind).values():
        if part.target.endswith(f":{name}"):
            return imported(part.target)
    raise AttributeError(f"there is no {kind} with a class {name}")


EXPERIMENTS: Registry[Any] = Registry(
    "advsearch.experiments",
    list_built_ins("experiment"),
    "an `advsearch.experiment.Experiment` whose command is the name of the entry point",
    lambda name, entry: (
        getattr(getattr(entry, "settings", None), "command", None) == name
    ),
)
"""Every experiment by the name of its command, imported when it is used."""


def get_experiment(name: str) -> Any:
    """Return an experiment by the name of its command. Raises UnknownNameError: there
    is none.
    """
    if name not in EXPERIMENTS:
        raise UnknownNameError("command", name, EXPERIMENTS)
    return EXPERIMENTS[name]


def get_experiment_help(name: str) -> str:
    """Return what an experiment does, in a line: of the catalog, or of an installed one
    the docstring's first line.
    """
    built_in = EXPERIMENTS.own.get(name)
    if isinstance(built_in, BuiltIn):
        return built_in.help
    summary = (
        (inspect.getdoc(get_experiment(name).function) or "")
        .partition("\n")[0]
        .rstrip(".")
    )
    return summary[:1].lower() + summary[1:]
