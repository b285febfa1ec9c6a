"""Work on many processors: batches carried out somewhere, here by default, and on workers of Dask when asked.

`executor` is all that the rest of advsearch knows of it. A batch may be carried out by anybody, any number of times:
what comes of it depends on it and on the run's settings alone.
"""
