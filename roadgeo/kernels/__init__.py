"""Numba kernels: ndarray in, ndarray out. They import numpy and numba only, state their preconditions, check nothing.

Every kernel has a slow, obvious twin of the same name in `tests/naive`.
"""
