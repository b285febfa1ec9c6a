"""Scripts that make the bundled files, in `advsearch/bundled/data`."""
