"""How a search gets its derivatives, and what it leaves out."""
