"""Compiling: modules as graphs, programs and C, and what must not stand in its way."""
