"""From the intersections of a mask to a place on a reference: index, search, verification, refinement, verdict."""
