"""Planes, frames and cameras: homographies, and the views that a camera can have."""
