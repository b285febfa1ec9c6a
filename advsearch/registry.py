"""Registries of experiments, controls, policies and so on, by name.

A registry contains the built-in parts of one kind, and those of installed packages. A
package adds a part by an entry point of the registry's group, see `docs/extending.md`.
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
    """A mapping from names to entries: the built-in ones, then those of installed
    packages.

    If a package has an entry with a built-in name, the built-in entry is used. An entry
    is imported on access, so that a package that cannot be imported affects no other.
    """

    group: str  # group of entry points: "advsearch.policies"
    # The built-in entries; those of the catalog are imported on access.
    built_ins: Mapping[str, Entry | BuiltIn]
    # Description of an entry for messages: "a subclass of Policy whose name is that of
    # the entry point".
    expected_entry: str
    is_valid_entry: Callable[
        [str, Any], bool
    ]  # whether an object under a name is an entry
    # Whether a class of the user is an entry, too, by the name "package.module:Class".
    # It is imported from the Python path or the current directory, and its name begins
    # with a capital letter.
    imports_user_classes: bool = False

    def __getitem__(self, name: str) -> Entry:
        """Return the entry of a name, and import it if that was not done yet.

        Args:
            name: name of a built-in entry or of an installed entry point, or
                "package.module:Class".

        Raises:
            InputError: the entry cannot be imported or has the wrong type, or only a
                file names this code and the user has not allowed it (`check_import`).
        """
        if self.is_class_path(name):
            return self._import_class(name)
        if name not in self.built_ins:
            return self._load_installed(name)
        built_in = self.built_ins[name]
        if not isinstance(built_in, BuiltIn):
            return built_in
        target: Entry = load_attribute(built_in.import_path)
        return target

    def _import_class(self, name: str) -> Entry:
        """Import "package.module:Class" from the Python path or the current directory.

        Raises:
            InputError: the class must not or cannot be imported, or it is no entry of
                this registry.
        """
        check_import(name)
        try:
            with current_directory_importable():
                entry: Entry = load_attribute(name)
        except Exception as error:  # the user's code may raise anything
            raise InputError(
                f"{name}: cannot be imported ({type(error).__name__}: {error}); "
                f"a module is looked for on the Python path and in {os.getcwd()}"
            ) from error
        if not self.is_valid_entry(getattr(entry, "kind", ""), entry):
            raise InputError(f"{name}: expected {self.expected_entry}, got {entry!r}")
        return entry

    def __contains__(self, name: object) -> bool:
        """Return whether there is an entry of this name.

        Nothing is imported for that, unless the name is "package.module:Class".

        Raises:
            InputError: such a class cannot be imported.
        """
        if not isinstance(name, str):
            return False
        if self.is_class_path(name):
            return self[name] is not None
        return name in self.built_ins or name in self._installed

    def __iter__(self) -> Iterator[str]:
        added = [name for name in self._installed if name not in self.built_ins]
        return iter([*self.built_ins, *added])

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def get_help(self, name: str) -> str:
        """Return a sentence about an entry: that of the catalog, or the first line of the
        entry's docstring; if it cannot be imported, why.
        """
        entry = self.built_ins.get(name)
        if isinstance(entry, BuiltIn):
            return f"{entry.help[0].upper()}{entry.help[1:]}."
        try:
            return get_first_doc_line(self[name])
        except InputError as error:
            return f"{error}."

    def list_usable(self) -> dict[str, Entry]:
        """Return all entries except those of packages that cannot be imported."""
        usable = dict[str, Entry]()
        for name in self:
            with suppress(InputError):
                usable[name] = self[name]
        return usable

    def is_class_path(self, name: str) -> bool:
        """Return whether a name stands for a class to import.

        "package.module:Class" does, if this registry allows it
        (`imports_user_classes`). "light:Key" does not if "light" is an entry: then it
        names an instance of that entry.
        """
        module, _, attribute = name.partition(":")
        is_class_name = attribute[:1].isupper() and attribute.isidentifier()
        if not self.imports_user_classes or not is_class_name:
            return False
        packages = module.split(".")
        if packages[0] in self.built_ins or packages[0] in self._installed:
            return False  # the name before the colon is that of an entry
        return all(package.isidentifier() for package in packages)

    @cached_property
    def _installed(self) -> dict[str, EntryPoint]:
        return {point.name: point for point in entry_points(group=self.group)}

    def _load_installed(self, name: str) -> Entry:
        """Import the object of an entry point of another package.

        Raises:
            InputError: the object cannot be imported, or has the wrong type.
        """
        point = self._installed[name]
        where = f"entry point {name} = {point.value} of group {self.group}"
        advice = "repair or uninstall the package that declares it"
        try:
            entry: Entry = point.load()
        except Exception as error:  # another package's code may raise anything
            raise InputError(
                f"{where}: cannot be imported ({error}); {advice}"
            ) from None
        if not self.is_valid_entry(name, entry):
            raise InputError(f"{where}: expected {self.expected_entry}; {advice}")
        return entry


def get_first_doc_line(entry: Any) -> str:
    """Return the summary of the docstring of a function, a class or an instance's
    class, on one line; a text is returned as it is, and "" for other plain values.
    """
    has_docstring = inspect.isroutine(entry) or inspect.isclass(entry)
    documented = entry if has_docstring else type(entry)
    if documented.__module__ == "builtins":
        return str(entry) if isinstance(entry, str) else ""
    summary = (inspect.getdoc(documented) or "").partition("\n\n")[0]
    return " ".join(summary.split())


def load_attribute(target: str) -> Any:
    """Import the attribute that "module:attribute" names."""
    module, _, attribute = target.partition(":")
    return getattr(import_module(module), attribute)


def get_class(kind: str, name: str) -> Any:
    """Import the class of a built-in part by its own name.

    Raises:
        AttributeError: there is none.
    """
    for part in list_built_ins(kind).values():
        if part.import_path.endswith(f":{name}"):
            return load_attribute(part.import_path)
    raise AttributeError(f"there is no {name!r}, and no {kind} with such a class")


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
    """Return an experiment by the name of its command.

    Raises:
        UnknownNameError: there is none.
    """
    if name not in EXPERIMENTS:
        raise UnknownNameError("command", name, EXPERIMENTS)
    return EXPERIMENTS[name]


def get_experiment_help(name: str) -> str:
    """Return a line about an experiment, which begins in lower case: that of the
    catalog, or the first line of the docstring of an installed one.
    """
    built_in = EXPERIMENTS.built_ins.get(name)
    if isinstance(built_in, BuiltIn):
        return built_in.help
    docstring = inspect.getdoc(get_experiment(name).function) or ""
    summary = " ".join(docstring.partition("\n\n")[0].split()).rstrip(".")
    return summary[:1].lower() + summary[1:]
