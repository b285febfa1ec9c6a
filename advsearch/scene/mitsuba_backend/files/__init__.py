"""Mitsuba's own scenes, from its XML files and Python dictionaries."""
