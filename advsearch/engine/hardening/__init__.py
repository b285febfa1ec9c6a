"""Making a model better: what it is trained on, how, and what it is measured on."""
