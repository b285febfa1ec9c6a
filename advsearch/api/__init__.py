"""Every question as a function, each in a module called as its command; `import advsearch` offers them all.

The command line calls the functions that end in `_from_config`.
"""

from __future__ import annotations

from advsearch import threads as threads  # before torch: it sets how OpenMP waits
