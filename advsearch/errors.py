"""The one tree of errors that a user can cause.

Every message says what was expected, what was got and what to do, and names the file or the setting as Python has it:
``epsilon: ...`` at its beginning, and in backticks elsewhere, as in "use `denoise=none`" or "`grid` pose.yaw". The
command line writes flags instead (`cli.flags.with_flags`) in one line on standard error, with exit status 2; anything
but an `AdvsearchError` is a bug and keeps its traceback.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class AdvsearchError(Exception):
    """Base of every error that is the input's fault or the machine's, not a bug of advsearch."""


class InputError(AdvsearchError):
    """A value given on the command line, in a file or in a call is outside what is allowed."""


class UnknownNameError(InputError):
    """A name that is not in a registry; the message lists near matches.

    Args:
        kind: what the name should have named, e.g. ``"object"``.
        name: the name that was given.
        known: every valid name.
        hint: an extra sentence (how to give a path instead, say); may be empty.
    """

    def __init__(self, kind: str, name: str, known: Iterable[str], hint: str = "") -> None:
        names = sorted(known)
        near = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
        guess = f" Did you mean {' or '.join(repr(n) for n in near)}?" if near else ""
        super().__init__(f"unknown {kind} {name!r}.{guess} Known: {', '.join(names)}.{' ' + hint if hint else ''}")
        self.near = tuple(near)


class FileFormatError(InputError):
    """A file that is missing, empty, truncated, or not what it should be. The message names the path."""


class ModelError(AdvsearchError):
    """A model that cannot be loaded, or whose output is not logits of shape (N, classes)."""


class RunExistsError(InputError):
    """The run directory exists already and `overwrite` was not asked for."""


class StorageError(AdvsearchError):
    """The run directory cannot be written (full disk, read-only file system, no permission)."""


class EnvironmentSetupError(AdvsearchError):
    """A part of the machine is missing or unusable (no usable LLVM, say). The message holds the command to type."""
