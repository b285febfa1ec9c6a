"""Python imports this in every process that has this folder in `PYTHONPATH`: islands are hidden there, too."""

import os

from hidden_islands import VARIABLE, hide

if os.environ.get(VARIABLE):
    hide(os.environ[VARIABLE].split(","))
