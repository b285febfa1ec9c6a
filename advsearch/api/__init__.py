"""The Python interface apart from the experiments: keywords, names, loading of runs,
and exports.
"""

# Imported before torch, since it sets how threads of OpenMP wait.
from advsearch import threads as threads
