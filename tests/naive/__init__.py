"""Slow, obvious twins of the kernels, and what they are compared on."""
