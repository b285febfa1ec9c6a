"""How pictures are differentiated: the plan, the motion of coordinates, the material form."""
