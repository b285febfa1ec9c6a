"""Linear light transport: pictures of a scene in which nothing moves, predicted without
rendering.
"""
