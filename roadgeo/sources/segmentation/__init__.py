"""From photographs to road masks: the model that ships, and how models are run."""
