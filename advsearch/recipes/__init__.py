"""Recipes: experiments as YAML files of the commands there are, with the figures that show what came out.

The files beside this one are the bundled recipes. `description` reads them, `table` gathers the answers of their runs,
`figures` has what is drawn and said of those. `advsearch.api.recipe` carries them out.
"""

from __future__ import annotations
