"""Files that appear whole or not at all, GeoPackages, QGIS styles."""
