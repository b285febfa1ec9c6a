"""Channels of a rendered image (H, W, C) before its background is added.

C is 3 for radiance alone and 4 over a background. Over a photograph it is 7 if a plane
takes the object's shadow, and 13 if that plane has a reflecting coat. A slice of
channels that an image lacks is empty.
"""

from __future__ import annotations

RADIANCE = slice(0, 3)  # of the object, linear
COVERAGE = slice(3, 4)  # fraction of the pixel that the object covers
PLANE_CHANGE = slice(4, 7)  # change of the plane's radiance by the object
COAT_CHANGE = slice(7, 10)  # change of what the plane's coat reflects
ENVIRONMENT_IN_COAT = slice(10, 13)  # what the coat reflects without the object
