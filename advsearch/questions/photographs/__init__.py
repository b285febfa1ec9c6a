"""Photographs of the real object: align them with renderings, evaluate and count."""
