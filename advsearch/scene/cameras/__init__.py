"""Cameras as they are calibrated: intrinsics and distortion, from a point to its pixel and back, and their files."""
