"""Statistics of counts and shares: intervals, sequential rules, paired and clustered tests.

Pure functions of numbers and arrays, each with its source. Nothing here knows a run, a trial or a drive.
"""
