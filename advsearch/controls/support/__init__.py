"""Functions and base classes that several controls use."""
