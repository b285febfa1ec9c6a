"""Places as geometry around the object: a glTF file and a YAML file that says what its
meshes are.
"""
