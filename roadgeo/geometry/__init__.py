"""Planes, frames and cameras: what a homography is, and what a camera can see."""
