"""Light kept on surfaces: pictures of a scene in which nothing moves but the camera,
for rays and look-ups alone.
"""
