"""The viewer: interactive HTML pages of runs, as single files or served by `advsearch
dashboard`.
"""
