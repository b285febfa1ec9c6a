"""What a scene inside Mitsuba leaves out because a search doesn't need it; each item can be put back by name.

None of it changes what is computed: pictures and gradients with and without agree to within their noise, and where the
random numbers are the same ones, to within rounding, which `advsearch plan` shows on the scene at hand. Bounces of
light are another matter (`engine.path_length`): leaving those out has a bias, so only the search does it, within a
measured bound, and the verification renders all of them.
"""

from __future__ import annotations

from collections.abc import Mapping

ITEMS: Mapping[str, str] = {
    "tracing": "tracing a render anew: it is recorded once and replayed",
    "uploads": "writing inputs that are as they were, with the sampling tables and the ray tracing tree that follow",
    "gradients": "derivatives of inputs that no coordinate reaches",
    "boundary": "boundary terms of an adjoint where nothing that it differentiates moves an outline",
    "lobes": "lobes of the object's surface that have no strength",
    "emitters": "samples of lamps that emit nothing",
}
"""What can be left out, by name, and what that is."""

EVERYTHING = frozenset(ITEMS)
"""Leave out all that can be."""
NOTHING: frozenset[str] = frozenset()
"""Leave out nothing: what a program has to do that knows neither scene nor search."""
