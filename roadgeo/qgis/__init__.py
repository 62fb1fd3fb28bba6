"""The QGIS plugin: `plugin` is the folder that QGIS loads; `installation` puts it there."""
