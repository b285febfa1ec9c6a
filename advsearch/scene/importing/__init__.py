"""Objects and environments from files: meshes, their surfaces and textures, radiance
maps.
"""
