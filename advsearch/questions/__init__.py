"""Questions that are rooms: each folder is the command, and holds the settings, what
carries it out, and the result.

`advsearch.registry` finds them; a folder that is deleted is a question that nobody can
ask.
"""
