"""Studies of the tool itself: error against run time, extreme cases, and what leaving things out brings."""
