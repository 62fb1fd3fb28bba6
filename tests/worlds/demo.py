"""The masks of the demonstration, by their names."""

from roadgeo.evaluation.demo import demo_masks

__all__ = ["DRONE", "MASKS"]

MASKS = {mask.path.stem: mask for mask in demo_masks()}
DRONE = MASKS["drone"].path
