"""Error against run time, and the settings that follow from it."""
