"""The bundled objects and environments, and the scripts that make them. Installed as `advsearch.bundled`."""
