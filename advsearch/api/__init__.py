"""What Python has beside the questions: keywords, names, runs that are loaded, and
exports.
"""

from advsearch import threads as threads  # before torch: it sets how OpenMP waits
