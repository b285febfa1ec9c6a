"""The bundled objects and environments as data, and the families that the objects are members of."""
