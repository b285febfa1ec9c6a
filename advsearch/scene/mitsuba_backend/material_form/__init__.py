"""The material form of the geometric adjoint: the interior term, the edges, and their view of a scene."""
