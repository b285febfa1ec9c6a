"""What several controls are made of; a module here is no control."""
