"""The stability suite: extreme cases, each with what must hold."""
