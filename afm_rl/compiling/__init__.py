"""Compiling: modules as machine code, and what must not stand in its way."""
