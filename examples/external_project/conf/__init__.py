"""Configuration of this project."""
