"""Scenes for other programs, as data of theirs."""
