"""Questions that are rooms: each folder holds the settings, what carries it out, the answer, words, page and command.

`advsearch.rooms` finds them; a folder that is deleted is a question that nobody can ask.
"""
