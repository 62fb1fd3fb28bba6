"""Made-up and real scenes, towns, networks and servers that tests look at."""
