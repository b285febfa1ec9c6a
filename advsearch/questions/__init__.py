"""Experiments: each directory is a command, with its settings, code and result.

`advsearch.registry` finds the directories. Without its directory, a command does not
exist.
"""
