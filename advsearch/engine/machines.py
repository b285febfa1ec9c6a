"""Machines that are not like the one that keeps a run: rows name them, and a reader is told what they are."""

from __future__ import annotations

import json
from dataclasses import dataclass, field

from advsearch.cluster.executor import Workforce
from advsearch.runs.directory import RunDirectory

NOTE = "machines"
"""The note under which the store keeps what they are."""


@dataclass
class Machines:
    """The other machines of a run.

    Attributes:
        run: keeps what they are; None keeps it in memory.
        known: by the name that rows have, what each is.
    """

    run: RunDirectory | None
    known: dict[str, dict[str, str]] = field(init=False)

    def __post_init__(self) -> None:
        self.known = (self.run.store.noted(NOTE) if self.run is not None else None) or {}

    def meet(self, name: str | None, facts: Workforce | None) -> None:
        """Keep what a machine is, unless it is known, or like this one (None)."""
        if name is None or name in self.known:
            return
        self.known[name] = dict(facts.machines.get(name, {})) if facts is not None else {}
        if self.run is not None:
            self.run.store.set_note(NOTE, json.dumps(self.known))

    @property
    def remarks(self) -> list[str]:
        """What a reader has to know."""
        if not self.known:
            return []
        told = "; ".join(", ".join(f"{key} {text}" for key, text in one.items()) for one in self.known.values())
        return [
            "Rows come from machines that are not alike, so that their last bits may differ; beside the one that kept "
            f"the run: {told}."
        ]
