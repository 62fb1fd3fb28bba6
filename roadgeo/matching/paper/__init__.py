"""The matcher of the paper (`--method pair`): pairs of intersections, by Li, Yang, Wang and He (arXiv 1906.12174)."""
