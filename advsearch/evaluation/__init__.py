"""Studies of the tool itself: how its reference model is made and how good it is."""
