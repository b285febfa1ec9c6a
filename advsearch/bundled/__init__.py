"""The bundled objects and environments, as data."""
