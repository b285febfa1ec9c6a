"""Places as geometry, made by script when a scene needs them: true to scale, to be seen from near and from afar."""
