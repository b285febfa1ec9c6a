"""Every question as a function, each in a module called as its command; `import advsearch` offers them all.

Each module also has a function that ends in `_from_config`, by which `carry_out` does what a file or a command line
says.
"""

from __future__ import annotations

from contextlib import nullcontext
from importlib import import_module
from typing import TYPE_CHECKING

from advsearch import rooms
from advsearch import threads as threads  # before torch: it sets how OpenMP waits
from advsearch.api.names import check_names
from advsearch.runs.directory import begun
from advsearch.runs.results import Result

if TYPE_CHECKING:
    from pathlib import Path

    from advsearch.progress import Progress
    from advsearch.runs.results import Result
    from advsearch.settings import Config


def carry_out(config: Config, *, progress: Progress | None = None, resumed: Path | None = None) -> Result:
    """Ask the question that a configuration asks, and keep the run in a directory.

    Args:
        config: of any command.
        progress: told how far it is.
        resumed: the folder of a run to go on with; None for a new run.

    Raises:
        InputError: anything that whoever asked can put right; nothing is written then.
    """
    check_names(config)
    keeps_run = resumed is None and getattr(config, "out", None) is None
    with begun(config) if keeps_run else nullcontext(resumed) as folder:  # before what is heavy is imported
        room = rooms.room(config.command)
        own = room.from_config if room else None
        if own is None:
            own = getattr(import_module(f"advsearch.api.{config.command}"), f"{config.command}_from_config")
        made = own(config, progress=progress, **({} if folder is None else {"resumed": folder}))
    result: Result = made if isinstance(made, Result) else made.summary
    return result
