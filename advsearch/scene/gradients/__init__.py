"""How pictures are differentiated: the plan, differences, and the motion of coordinates."""
