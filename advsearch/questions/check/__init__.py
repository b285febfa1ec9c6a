"""Every derivative of a scene beside differences."""
