"""`attack`: the worst configuration of a scene, or of several."""
