"""How pictures are differentiated: the plan, and the motion of coordinates."""
