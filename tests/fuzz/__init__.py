"""A seeded fuzz of the files that users name: each is read or refused, quickly, in little memory, and quietly."""
