"""Photographs of the real thing, aligned with renderings, judged and counted."""
