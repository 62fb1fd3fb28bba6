"""Programs that tests drive: browser, QGIS, validators, killers."""
